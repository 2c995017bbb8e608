"""What was wrong is one line on the terminal and an exit code; faults of the program show."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from redetect.command_line import EXIT_ERROR, EXIT_UNREAD, exit_code_of
from redetect.interrupts import EXIT_INTERRUPTED
from redetect.messages import OneLineError


class WrongFileError(OneLineError, ValueError):
    pass


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (WrongFileError("e.cam:3: wrong"), EXIT_ERROR, "error: e.cam:3: wrong\n"),
        (ValueError("two\nlines\x1b[2J"), EXIT_ERROR, "error: two\\nlines\\x1b[2J\n"),
        (OSError(28, "No space left", "e.csv"), 1, "error: [Errno 28] No space left: 'e.csv'\n"),
        (
            FileNotFoundError(2, "No such file or directory", "gone/e.csv"),
            EXIT_ERROR,
            "error: gone/e.csv: no such folder: gone: make it first, or name another\n",
        ),
        (
            NotADirectoryError(20, "Not a directory", f"{__file__}/e.csv"),
            EXIT_ERROR,
            f"error: {__file__}: is not a folder: expected one, or the name of a new one\n",
        ),
        (
            IsADirectoryError(21, "Is", "."),
            1,
            "error: .: is a folder: expected the name of a file\n",
        ),
        (KeyboardInterrupt(), EXIT_INTERRUPTED, "interrupted\n"),
    ],
)
def test_one_line_and_a_code(
    error: BaseException, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def work() -> int:
        raise error

    assert exit_code_of(work) == code
    assert capsys.readouterr() == ("", said)


def test_the_works_own_code_comes_back(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code_of(lambda: 3) == 3
    assert capsys.readouterr() == ("", "")


def test_a_fault_of_the_program_is_not_hidden() -> None:
    def work() -> int:
        raise KeyError("no such thing")

    with pytest.raises(KeyError):
        exit_code_of(work)


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("lines", [1, 100_000])
def test_nobody_reads_on_what_is_printed(lines: int, unbuffered: str) -> None:
    """As with ``| head``: a quiet end, whether it shows while printing or at the last flush."""
    code = f"""if True:
        import sys
        from redetect.command_line import exit_code_of
        sys.stdin.read()
        sys.exit(exit_code_of(lambda: [print("row") for _ in range({lines})] and 0))
    """
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        process.stdin.close()
        assert process.stderr.read() == b""
    assert process.returncode == EXIT_UNREAD


def test_a_pipe_of_ones_own_that_broke_is_an_error(capfd: pytest.CaptureFixture[str]) -> None:
    def work() -> int:
        raise BrokenPipeError(32, "Broken pipe", "elsewhere")

    assert exit_code_of(work) == EXIT_ERROR
    assert capfd.readouterr().err == "error: [Errno 32] Broken pipe: 'elsewhere'\n"


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("words", ["redetect --version", "redetect --help", "detect --version"])
def test_an_output_without_space_is_one_line(words: str, unbuffered: str) -> None:
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", *words.split()],
            stdout=full,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
            check=False,
        )
    assert done.returncode == EXIT_ERROR
    assert done.stderr == b"error: [Errno 28] No space left on device\n"
