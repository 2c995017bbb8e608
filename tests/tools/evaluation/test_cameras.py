"""Discs before random cameras are found."""

from __future__ import annotations

import pytest

from tools.evaluation.cameras import Cameras


@pytest.mark.long
def test_discs_of_all_sizes_are_found() -> None:
    figures = Cameras(cameras=1, scenes=3).measure()
    classes = [values for name, values in figures.items() if name != "elsewhere"]
    shown = sum(values["shown"] for values in classes)
    assert shown > 5
    assert sum(values["found"] * values["shown"] for values in classes) > 0.9 * shown
    assert figures["elsewhere"] <= 1
