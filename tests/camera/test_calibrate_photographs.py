"""Real photographs of disc boards: what is held out is explained as well as by OpenCV's model."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.evaluation.calibration import compare


@pytest.mark.long
@pytest.mark.parametrize(("group", "every"), [("asym", 1), ("rct", 1), ("robvis", 6), ("sym", 1)])
def test_held_out_photographs_are_explained_as_well_as_by_opencv(
    shared_data: Path, group: str, every: int
) -> None:
    """Of some 500 discs of a photograph every sixth says as much."""
    photographs = shared_data / "discs" / "dev"
    found = compare(photographs, group, peers=["rational"], every=every)
    assert found.views >= 5
    for split, errors in found.errors.items():
        assert errors["ours"] <= errors["rational"], split
