"""The scanners on board: ranges against walls by incidence, and mounts that come back."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.lasers.walls import first_walls
from redetect.groundtruth.validation.onboard import (
    ReferencePose,
    range_errors,
    reference_poses,
    refine_mounts,
)
from redetect.groundtruth.validation.reference_poses import poses_from_distances
from redetect.plane import compose, pose_differences
from tests.groundtruth.validation.test_validate_references import (
    ROOM,
    measured,
    onboard,
    survey_of,
)


def test_rays_meet_the_first_wall_at_its_angle() -> None:
    walls = np.array([[2.0, -5.0, 2.0, 5.0], [3.0, -5.0, 3.0, 5.0]])
    angles = np.radians([0.0, 30.0, -60.0, 180.0])
    rays = np.column_stack([np.cos(angles), np.sin(angles)])
    far, first, cosines = first_walls(np.zeros(2), rays, walls)
    np.testing.assert_allclose(far, [2.0, 2.0 / math.cos(math.pi / 6), 4.0, np.inf])
    assert not np.any(first)
    np.testing.assert_allclose(cosines, np.abs(np.cos(angles)))


def references(
    rng: np.random.Generator, shift: np.ndarray, count: int, sigma_m: float = 0.003
) -> list[ReferencePose]:
    """Reference poses of a robot whose scanners are mounted off by `shift` from what is said."""
    survey = survey_of(sigma_m=sigma_m)
    found = []
    for _ in range(count):
        truth = np.array([rng.uniform(2, 8), rng.uniform(2, 4.5), rng.uniform(-3.1, 3.1)])
        rows = measured(truth, survey, rng)
        # The readings are cast from where the scanners really are.
        seen = onboard(compose(truth, shift), ROOM, rng)
        references, refused = reference_poses(poses_from_distances(survey, rows), seen, ROOM)
        assert not refused
        found += references
    return found


def test_range_errors_are_those_of_the_readings() -> None:
    found = references(np.random.default_rng(2), np.zeros(3), 4)
    angles, errors = range_errors(found, ROOM)
    assert len(errors) > 500
    assert abs(errors.mean()) < 5e-4
    assert errors.std() < 0.02
    assert angles.min() >= 0.0
    assert angles.max() <= 0.5 * math.pi


@pytest.mark.long
def test_mounts_come_back_with_their_covariance() -> None:
    """All scanners moved together against the body, which distances alone can tell."""
    rng = np.random.default_rng(3)
    shift = np.array([0.006, -0.004, math.radians(0.2)])
    total = 0.0
    for _ in range(6):
        found = refine_mounts(references(rng, shift, 8), ROOM)
        assert found is not None
        given = np.array([[0.3, 0.0, 0.0], [-0.4, 0.0, math.pi]])
        error = found.poses - compose(np.broadcast_to(shift, given.shape), given)
        error[:, 2] = (error[:, 2] + math.pi) % (2 * math.pi) - math.pi
        assert np.abs(error[:, :2]).max() < 0.004
        total += float(error.ravel() @ np.linalg.solve(found.covariance, error.ravel()))
    low, high = chi2.ppf([0.001, 0.999], 36)
    assert low < total < high


@pytest.mark.parametrize("shift", [(0.1, -0.05, 0.0), (0.02, 0.0, 0.087), (0.0, 0.0, -0.087)])
def test_mounts_that_are_far_off_come_back(shift: tuple[float, float, float]) -> None:
    """Both scanners 11 cm or five degrees off, with which their scans contradict the distances."""
    found = refine_mounts(references(np.random.default_rng(6), np.array(shift), 8), ROOM)
    assert found is not None
    given = np.array([[0.3, 0.0, 0.0], [-0.4, 0.0, math.pi]])
    off = pose_differences(found.poses, compose(np.broadcast_to(shift, given.shape), given))
    assert np.abs(off[:, :2]).max() < 0.006
    assert np.abs(off[:, 2]).max() < 0.01


def test_mounts_that_do_not_fit_the_walls_are_refused() -> None:
    with pytest.raises(GeometryError, match="mounts are not refined"):
        refine_mounts(references(np.random.default_rng(6), np.array([0.6, 0.5, 0.7]), 8), ROOM)


def test_a_scanner_without_readings_costs_no_other_its_mount() -> None:
    found = references(np.random.default_rng(5), np.zeros(3), 4)
    blind = []
    for reference in found:
        assert reference.averaged is not None
        first, second = reference.averaged.scans
        nothing = second._replace(range_m=np.zeros(0), direction=np.zeros((0, 2)))
        averaged = reference.averaged._replace(scans=(first, nothing))
        blind.append(replace(reference, averaged=averaged))
    refined = refine_mounts(blind, ROOM)
    assert refined is not None
    assert refined.scanners == blind[0].averaged.scanners[:1]  # type: ignore[union-attr]
    np.testing.assert_allclose(refined.poses, [[0.3, 0.0, 0.0]], atol=0.01)
    assert refined.covariance.shape == (3, 3)


def test_two_poses_are_too_few_for_mounts() -> None:
    assert refine_mounts(references(np.random.default_rng(4), np.zeros(3), 2), ROOM) is None
