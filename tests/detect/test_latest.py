"""What is kept of the latest object is that object's."""

from __future__ import annotations

import pytest

from detect.latest import kept_for_latest


def test_a_result_is_kept_as_long_as_the_object_is_the_same() -> None:
    asked: list[list[int]] = []

    @kept_for_latest
    def length(values: list[int]) -> int:
        asked.append(values)
        return len(values)

    first, equal, other = [1, 2], [1, 2], [3]
    assert [length(first), length(first), length(other), length(other)] == [2, 2, 1, 1]
    assert [length(first), length(equal)] == [2, 2]
    assert list(map(id, asked)) == list(map(id, [first, other, first, equal]))


def test_what_fails_is_asked_again() -> None:
    answers: list[int | Exception] = [5, ZeroDivisionError()]

    @kept_for_latest
    def once_failing(_: object) -> int:
        answer = answers.pop()
        if isinstance(answer, Exception):
            raise answer
        return answer

    about = object()
    with pytest.raises(ZeroDivisionError):
        once_failing(about)
    assert [once_failing(about), once_failing(about)] == [5, 5]
