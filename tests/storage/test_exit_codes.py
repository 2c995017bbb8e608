"""What was wrong is one line on the terminal and an exit code; faults of the program show."""

from __future__ import annotations

import pytest

from storage.exit_codes import EXIT_ERROR, EXIT_INTERRUPTED, exit_code_of
from storage.messages import OneLineError


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
