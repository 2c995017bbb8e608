"""Real photographs of disc boards: what is held out is explained as well as by OpenCV's model."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.evaluation.calibration import compare


@pytest.mark.long
@pytest.mark.parametrize("group", ["asym", "rct", "robvis", "sym"])
def test_held_out_photographs_are_explained_as_well_as_by_opencv(
    shared_data: Path, group: str
) -> None:
    photographs = shared_data / "discs" / "dev"
    found = compare(photographs, group, free_aspect=True, peers=["rational"])
    assert found.views >= 5
    for split, errors in found.errors.items():
        assert errors["ours"] <= errors["rational"], split
