"""Scans matched without odometry: poses from no motion, and ambiguity."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from redetect.groundtruth.errors import GeometryError
from redetect.landmarks import wrap_angle
from redetect.plane import between, compose
from tests.groundtruth.lasers.scene import ROOM, cast
from tools.evaluation.scan_matching import match_scans

FloatArray = NDArray[np.float64]

ANGLES = np.radians(np.arange(-90.0, 91.0))


def scan(pose: FloatArray, rng: np.random.Generator, sigma_m: float = 0.01) -> FloatArray:
    ranges = cast(pose, ANGLES, ROOM) + rng.normal(0.0, sigma_m, len(ANGLES))
    return np.stack([ranges * np.cos(ANGLES), ranges * np.sin(ANGLES)], axis=-1)


@pytest.mark.parametrize("turn_deg", [0.0, 12.0, -35.0, 90.0])
def test_scans_are_matched_from_no_motion(turn_deg: float) -> None:
    rng = np.random.default_rng(9)
    first = np.array([3.0, 2.0, 0.8])
    second = compose(first, np.array([0.15, -0.05, np.radians(turn_deg)]))
    match = match_scans(scan(second, rng), scan(first, rng))
    truth = between(first, second)
    assert match.pose[:2] == pytest.approx(truth[:2], abs=0.01)
    assert wrap_angle(match.pose[2] - truth[2]) == pytest.approx(0.0, abs=np.radians(0.4))
    assert match.explained > match.rival
    assert len(match.undetermined) == 0
    assert not match.ambiguous


def test_one_start_is_not_enough_for_a_large_turn() -> None:
    """What the many headings are for."""
    rng = np.random.default_rng(10)
    first = np.array([3.0, 2.0, 0.8])
    second = compose(first, np.array([0.1, 0.0, np.radians(80.0)]))
    one = match_scans(
        scan(second, rng), scan(first, rng), heading_step_deg=360.0, largest_shift_m=100.0
    )
    assert abs(one.pose[2] - np.radians(80.0)) > np.radians(3.0)


@pytest.mark.parametrize("seed", range(5))
def test_a_corridor_is_ambiguous_and_the_covariance_says_so(seed: int) -> None:
    """A few readings of somebody who walks along with the robot tell it that it stands."""
    rng = np.random.default_rng(seed)
    walls = np.array([[-40.0, -1.0, 40.0, -1.0], [40.0, 1.0, -40.0, 1.0]])
    angles = np.radians(np.arange(-90.0, 90.1, 0.25))
    scans = []
    for x in (0.0, 0.4):
        ranges = cast(np.array([x, 0.0, 0.0]), angles, walls)
        ranges += rng.normal(0.0, 0.01, len(angles))
        seen = ranges < 5.0
        beams = np.stack([np.cos(angles), np.sin(angles)], axis=-1)[seen]
        person = np.array([2.0, 0.3]) + rng.normal(0.0, 0.01, (8, 2))
        scans.append(np.concatenate([ranges[seen, None] * beams, person]))
    match = match_scans(scans[1], scans[0])
    error = match.pose - [0.4, 0.0, 0.0]
    assert match.ambiguous
    assert abs(error[0]) > 0.15
    assert math.sqrt(match.covariance[0, 0]) > 0.15
    assert math.sqrt(match.covariance[1, 1]) < 0.1
    assert abs(error[0]) < 3.0 * math.sqrt(match.covariance[0, 0])


def test_too_few_points_are_said() -> None:
    with pytest.raises(GeometryError, match="10 or more"):
        match_scans(np.zeros((5, 2)), np.zeros((50, 2)))
