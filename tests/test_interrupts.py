"""Interrupts that arrive while a kernel runs."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.compiled import kernel
from redetect.interrupts import interrupts_noted, outside_kernels


class _AlarmError(Exception):
    """The alarm clock rang."""


class _Sums(NamedTuple):
    forward: FloatArray
    backward: FloatArray


@kernel()
def _sums(values: FloatArray) -> _Sums:
    forward, backward = np.zeros(len(values)), np.zeros(len(values))
    for k in range(1, len(values)):
        forward[k] = forward[k - 1] + values[k]
        backward[-1 - k] = backward[-k] + values[-1 - k]
    return _Sums(forward, backward)


def _sums_for_ever(found: list[_Sums], alarm_s: float) -> None:
    values = np.ones(20_000)
    signal.setitimer(signal.ITIMER_REAL, alarm_s)
    while True:
        found[:] = [_sums(values)]


@pytest.fixture
def alarm() -> Iterator[None]:
    """The alarm clock raises an exception, but not within kernels."""

    def interrupt(*_: object) -> None:
        raise _AlarmError

    before = signal.signal(signal.SIGALRM, outside_kernels(interrupt))
    yield
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("alarm")
def test_interrupts_leave_results_of_kernels_whole() -> None:
    found = [_sums(np.ones(3))]
    tracing = sys.gettrace()
    for k in range(300):
        with pytest.raises(_AlarmError):
            _sums_for_ever(found, 0.0005 + 3e-6 * k)
        assert found[0].forward[-1] in (2.0, 19_999.0)
        assert sys.gettrace() is tracing


@pytest.mark.usefixtures("alarm")
def test_elsewhere_they_are_raised_at_once() -> None:
    with pytest.raises(_AlarmError):
        signal.raise_signal(signal.SIGALRM)


def test_the_handler_before_is_the_one_after() -> None:
    before = signal.getsignal(signal.SIGINT)
    with interrupts_noted(), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_other_threads_leave_interrupts_alone() -> None:
    seen = []

    def work() -> None:
        with interrupts_noted():
            seen.append(signal.getsignal(signal.SIGINT))

    before = signal.getsignal(signal.SIGINT)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]
