"""Steps that are much worse than stated: without identifiers, the discs are found again."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.landmarks.map_file import LandmarkMap, MapLandmarks, no_landmarks
from redetect.slam.association.run import associate_run
from redetect.slam.association.scoring import score_association
from redetect.slam.filters.ekf_slam import EkfSlam, run_ekf
from redetect.slam.filters.localizer import localize_run
from redetect.slam.filters.run import Associator
from tests.slam.small_run import SmallRun, small_run

_DISCS = 20


def run_with_slips(seed: int, degrees: float = 10.0) -> SmallRun:
    """A run whose odometry turns too much, once in either lap, and sees no lines."""
    run = small_run(seed, discs=_DISCS)
    run.recording.steps[[20, 45], 2] += np.radians(degrees)
    return replace(run, recording=replace(run.recording, lines=run.recording.lines.only(slice(0))))


def errors_m(poses: FloatArray, run: SmallRun) -> FloatArray:
    return np.asarray(np.linalg.norm(poses[:, :2] - run.poses[:, :2], axis=1))


@pytest.mark.parametrize("method", ["nearest", "joint"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_localisation_survives_slips(method: Literal["nearest", "joint"], seed: int) -> None:
    run = run_with_slips(seed)
    discs = MapLandmarks(
        np.arange(1, _DISCS + 1), run.disc_xy, np.zeros((_DISCS, 2, 2)), np.ones(_DISCS, np.int64)
    )
    found = localize_run(run.recording, LandmarkMap(discs, no_landmarks()), Associator(method))
    right = found.disc_ids == run.recording.circles.ids
    assert np.mean(right) > 0.9
    assert errors_m(found.path.poses, run).max() < 0.25


@pytest.mark.parametrize("method", ["nearest", "joint"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_slam_survives_slips(method: Literal["nearest", "joint"], seed: int) -> None:
    run = run_with_slips(seed)
    found = run_ekf(run.recording, EkfSlam(), Associator(method))
    assert errors_m(found.path.poses, run).max() < 0.25


@pytest.mark.parametrize("degrees", [10.0, 20.0])
@pytest.mark.parametrize("seed", [3, 4, 6])
def test_association_survives_slips(degrees: float, seed: int) -> None:
    run = run_with_slips(seed, degrees)
    found = associate_run(run.recording)
    score = score_association(found.circle_labels, [(k,) for k in run.recording.circles.ids])
    assert score.pair_precision == 1.0
    assert score.pair_recall > 0.95
