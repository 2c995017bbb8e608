"""The text of JSON: types, numbers that are not finite, layouts."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from redetect.json_text import json_rows, json_text


@dataclass(frozen=True)
class _Record:
    place: Path
    sizes: tuple[float, ...]


CONTENT = {
    "b": np.array([[1.0, math.nan], [-math.inf, 1e-9]]),
    "a": [_Record(Path("a/b"), (0.1, 2.0))],
    "none": (),
    "whole": np.int64(3),
}
PLAIN = {
    "b": [[1.0, None], [None, 1e-9]],
    "a": [{"place": "a/b", "sizes": [0.1, 2.0]}],
    "none": [],
    "whole": 3,
}


@pytest.mark.parametrize("text", [json_text(CONTENT), json_text(CONTENT, None), json_rows(CONTENT)])
def test_values_and_their_order_are_kept_and_what_is_not_finite_is_null(text: str) -> None:
    def refuse(word: str) -> Any:
        raise ValueError(word)

    found = json.loads(text, parse_constant=refuse)
    assert found == PLAIN
    assert list(found) == list(PLAIN)


def test_infinite_limits_can_stay() -> None:
    assert json_text((math.inf, -math.inf, math.nan), None, limits=True) == (
        "[Infinity, -Infinity, null]"
    )


def test_rows_have_a_line_per_entry_and_per_row_of_a_matrix() -> None:
    assert json_rows({"m": [[1, 2], [3, 4]], "v": [1, 2]}) == (
        '{\n "m": [\n  [1, 2],\n  [3, 4]\n ],\n "v": [1, 2]\n}'
    )
