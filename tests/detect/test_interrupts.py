"""Interrupts: also those that were swallowed or came out as something else."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from detect import cli
from detect.cli import main
from detect.terminal import progress_bar
from redetect.interrupts import (
    interrupts_deferred,
    interrupts_noted,
    raise_if_interrupt_waits,
    raise_if_interrupted,
)
from tests.detect.commands import Captured


@pytest.fixture
def caught() -> Iterator[None]:
    """Interrupts are raised, whatever this process was started to do with them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("caught")
@pytest.mark.parametrize("other", [SystemError, ValueError, OSError])
def test_what_an_interrupt_turned_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured, other: type[Exception]
) -> None:
    def disguise(_: object) -> int:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise other("with an exception set") from None
        return 0

    monkeypatch.setattr(cli.DetectProgram, "carry_out", staticmethod(disguise))
    before = signal.getsignal(signal.SIGINT)
    assert main(["compare", str(tmp_path)]) == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.usefixtures("caught")
def test_a_swallowed_interrupt_comes_back_after_the_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = []

    def swallow(_: object) -> int:
        with progress_bar("frames", 5) as advance:
            for frame in range(5):
                frames.append(frame)
                if frame == 2:
                    with contextlib.suppress(KeyboardInterrupt):
                        signal.raise_signal(signal.SIGINT)
                advance()
        return 0

    monkeypatch.setattr(cli.DetectProgram, "carry_out", staticmethod(swallow))
    assert main(["compare", str(tmp_path)]) == 130
    assert frames == [0, 1, 2]
    assert main(["compare", str(tmp_path)]) == 130  # the note of one run is none of the next
    assert frames == [0, 1, 2, 0, 1, 2]


def interrupted_block(done: list[str], patience_s: float) -> None:
    """Interrupted half-way; some time is left for another thread to run and take the interrupt."""
    told, telling = os.pipe()
    os.set_blocking(telling, False)
    before = signal.set_wakeup_fd(telling)
    try:
        with interrupts_deferred():
            os.kill(os.getpid(), signal.SIGINT)
            taken, _, _ = select.select([told], [], [], patience_s)
            done += ["another thread", "the block"] if taken else ["the block"]
    finally:
        signal.set_wakeup_fd(before)
        os.close(told)
        os.close(telling)


@pytest.mark.usefixtures("caught")
def test_an_interrupt_waits_for_the_end_of_what_must_not_be_torn() -> None:
    before = signal.getsignal(signal.SIGINT)
    done: list[str] = []
    with interrupts_noted():
        with pytest.raises(KeyboardInterrupt):
            interrupted_block(done, patience_s=0.5)
        with pytest.raises(KeyboardInterrupt):
            raise_if_interrupted()
    assert done[-1] == "the block"
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_that_another_thread_takes_waits_too(caught: None) -> None:
    begun, end = threading.Event(), threading.Event()

    def wait() -> None:
        begun.set()
        end.wait()

    other = threading.Thread(target=wait)  # does not block the interrupt, as the first one does
    other.start()
    begun.wait()
    done: list[str] = []
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted_block(done, patience_s=60.0)
    finally:
        end.set()
        other.join()
    assert done == ["another thread", "the block"]


def test_without_an_interrupt_nothing_is_raised() -> None:
    before = signal.getsignal(signal.SIGINT)
    with interrupts_deferred():
        pass
    with pytest.raises(ValueError, match="own"), interrupts_deferred():
        raise ValueError("own")
    assert signal.getsignal(signal.SIGINT) is before


def test_an_ignored_interrupt_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts_deferred():
            os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_nowhere_to_keep_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    """What Numba says of a read-only program without a cache folder is no help to its user."""
    from numba.core.caching import FunctionCache

    def compile_one(_: object) -> int:
        FunctionCache(compile_one)
        return 0

    monkeypatch.setattr(FunctionCache._impl_class, "_locator_classes", [])
    monkeypatch.setattr(cli.DetectProgram, "carry_out", staticmethod(compile_one))
    assert main(["compare", str(tmp_path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "NUMBA_CACHE_DIR" in line


def test_an_error_of_the_program_is_no_interrupt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slip(_: object) -> int:
        raise SystemError("a slip")

    monkeypatch.setattr(cli.DetectProgram, "carry_out", staticmethod(slip))
    with pytest.raises(SystemError, match="a slip"):
        main(["compare", str(tmp_path)])


def test_an_interrupt_that_waits_can_be_asked_for(caught: None) -> None:
    def wait_with_it() -> None:
        with interrupts_deferred():
            raise_if_interrupt_waits()  # none yet
            signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                raise_if_interrupt_waits()

    with pytest.raises(KeyboardInterrupt):
        wait_with_it()
    raise_if_interrupt_waits()  # that one was raised
