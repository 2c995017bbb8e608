"""Reference poses: exact distances give exact poses, honest covariances, and refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2

from redetect.groundtruth.lasers.scanners import Scans
from redetect.groundtruth.lasers.walls import wall_curves
from redetect.groundtruth.validation.onboard import Onboard, averaged_scans, refined_by_walls
from redetect.groundtruth.validation.reference_poses import (
    Distance,
    DistancePose,
    Measured,
    Survey,
    distance_residuals,
    poses_from_distances,
)
from redetect.landmarks import wrap_angle
from redetect.plane import compose
from tests.groundtruth.lasers.scene import cast, scanner

FloatArray = NDArray[np.float64]

FIDUCIALS = {"SW": (0.0, 0.0), "SE": (10.0, 0.0), "NE": (10.0, 7.0), "NW": (0.0, 7.0)}
POINTS = {"left": (0.2, 0.3), "right": (0.2, -0.3), "back": (-0.4, 0.0)}
# A room that no turn and no mirror image takes to itself.
ROOM = np.array(
    [
        [0, 0, 10, 0], [10, 0, 10, 7], [10, 7, 6, 7], [6, 7, 6, 6], [6, 6, 0, 6], [0, 6, 0, 0],
        [3, 0, 3, 0.8],
    ],
    dtype=float,
)  # fmt: skip


def survey_of(
    fiducials: dict[str, tuple[float, float]] | None = None,
    points: dict[str, tuple[float, float]] | None = None,
    sigma_m: float = 0.005,
) -> Survey:
    return Survey(
        {name: np.array(xy) for name, xy in (fiducials or FIDUCIALS).items()},
        {name: np.array(xy) for name, xy in (points or POINTS).items()},
        sigma_m,
    )


def measured(
    pose: tuple[float, float, float] | FloatArray,
    survey: Survey,
    rng: np.random.Generator | None = None,
    stand: int = 0,
    time_s: float = 5.0,
) -> list[Distance]:
    x, y, theta = pose
    c, s = math.cos(theta), math.sin(theta)
    rows = []
    for name, (px, py) in survey.robot_points.items():
        for fiducial, (fx, fy) in survey.fiducials.items():
            length = math.hypot(x + c * px - s * py - fx, y + s * px + c * py - fy)
            noise = 0.0 if rng is None else survey.sigma_m * rng.normal()
            rows.append(Distance(stand, time_s, name, fiducial, length + noise))
    return rows


def solved(rows: list[Distance], survey: Survey) -> DistancePose:
    (pose,) = poses_from_distances(survey, rows)
    return pose


def onboard(pose: FloatArray, walls: FloatArray, rng: np.random.Generator) -> list[Onboard]:
    """A second of scans of a robot that stands."""
    boards = []
    times = np.arange(4.5, 5.5, 0.02)
    for name, mounting in (("front", (0.3, 0.0, 0.0)), ("rear", (-0.4, 0.0, math.pi))):
        mounted = scanner(name, np.array(mounting), max_range_m=30.0)
        ranges = []
        exact = cast(compose(pose, mounted.pose), mounted.angles_rad, walls)
        for _ in times:
            noisy = exact + mounted.sigma_m * rng.normal(size=len(exact))
            ranges.append(np.where(np.isfinite(noisy), np.rint(1e3 * noisy), 0).astype(np.uint16))
        boards.append(Onboard(mounted, Scans(times, np.stack(ranges))))
    return boards


@given(st.floats(0.5, 9.5), st.floats(0.5, 6.5), st.floats(-math.pi, math.pi))
def test_exact_distances_give_the_exact_pose(x: float, y: float, theta: float) -> None:
    survey = survey_of()
    found = solved(measured((x, y, theta), survey), survey)
    assert found.status == "ok"
    np.testing.assert_allclose(found.pose[:2], [x, y], atol=1e-7)
    assert abs(float(wrap_angle(found.pose[2:] - theta)[0])) < 1e-7
    assert found.dof == 9


@pytest.mark.long
def test_the_origin_of_the_world_does_not_matter() -> None:
    """Coordinates of a map may be large: converged copies of one minimum must not differ."""
    rng, far = np.random.default_rng(2), np.array([9e5, -9e5])
    for _ in range(6):
        near = {f"f{k}": rng.uniform([-2.0, -2.0], [12.0, 9.0]) for k in range(4)}
        pose = np.array([*rng.uniform([0.0, 0.0], [10.0, 7.0]), rng.uniform(-3.1, 3.1)])
        survey = survey_of({name: tuple(xy + far) for name, xy in near.items()})
        found = solved(measured(pose + np.append(far, 0.0), survey, rng), survey)
        assert found.status == "ok"
        assert np.abs(found.pose[:2] - far - pose[:2]).max() < 0.03


def test_the_covariance_is_that_of_the_errors() -> None:
    rng = np.random.default_rng(1)
    survey = survey_of()
    truth = np.array([3.0, 2.0, 3.1])
    squared, costs = [], []
    for _ in range(50):
        found = solved(measured(truth, survey, rng), survey)
        error = found.pose - truth
        error[2] = (error[2] + math.pi) % (2 * math.pi) - math.pi
        squared.append(error @ np.linalg.solve(found.covariance, error))
        costs.append(found.chi2)
    low, high = chi2.ppf([0.001, 0.999], 150)
    assert low < sum(squared) < high
    low, high = chi2.ppf([0.001, 0.999], 450)
    assert low < sum(costs) < high


def test_the_derivative_is_that_of_the_residuals() -> None:
    rng = np.random.default_rng(2)
    fiducials, levers = rng.normal(size=(5, 2)) * 4, rng.normal(size=(5, 2))
    pose, lengths = rng.normal(size=3), np.ones(5)
    rows = Measured(fiducials, levers, lengths, 1.0)
    _, jacobian = distance_residuals(pose, rows)
    for axis in range(3):
        ends = []
        for sign in (1, -1):
            other = pose.copy()
            other[axis] += sign * 1e-6
            ends.append(distance_residuals(other, rows)[0])
        np.testing.assert_allclose((ends[0] - ends[1]) / 2e-6, jacobian[:, axis], atol=1e-8)


def test_points_in_a_line_leave_the_mirror_image_and_it_is_said() -> None:
    line = {"a": (0.0, 0.0), "b": (4.0, 0.0), "c": (10.0, 0.0)}
    points = {"front": (0.3, 0.0), "back": (-0.4, 0.0)}
    survey = survey_of(line, points)
    found = solved(measured((3.0, 2.0, 0.4), survey), survey)
    assert found.status == "ambiguous"
    assert "2 poses fit" in found.reason
    assert "(3.00, 2.00, 23 deg)" in found.reason
    assert "(3.00, -2.00, -23 deg)" in found.reason
    # Three points that are not in a line fit one side only.
    survey = survey_of(line)
    found = solved(measured((3.0, 2.0, 0.4), survey), survey)
    assert found.status == "ok"
    np.testing.assert_allclose(found.pose, [3.0, 2.0, 0.4], atol=1e-7)


@pytest.mark.parametrize(
    ("keep", "message"),
    [
        (lambda row: row.fiducial == "SW" and row.point != "back", "2 distances"),
        (lambda row: row.fiducial == "SW", "too uncertain"),
    ],
)
def test_too_little_for_a_pose_is_said(keep: object, message: str) -> None:
    assert callable(keep)
    survey = survey_of()
    rows = [row for row in measured((3.0, 2.0, 0.4), survey) if keep(row)]
    found = solved(rows, survey)
    assert found.status == "undetermined"
    assert message in found.reason


def test_a_gross_error_is_named() -> None:
    rng = np.random.default_rng(3)
    survey = survey_of()
    rows = measured((6.0, 3.0, -2.0), survey, rng)
    wrong = rows[7]
    rows[7] = Distance(0, 5.0, wrong.point, wrong.fiducial, wrong.distance_m + 0.5)
    found = solved(rows, survey)
    assert found.status == "inconsistent"
    assert np.argmax(found.residuals_m) == 7
    assert f"that of {wrong.point} from {wrong.fiducial}" in found.reason


def test_distances_that_contradict_each_other_are_refused() -> None:
    survey = survey_of()
    rows = measured((6.0, 3.0, -2.0), survey)
    rows = [Distance(0, 5.0, r.point, r.fiducial, r.distance_m + 0.3 * (k % 3)) for k, r in
            enumerate(rows)]  # fmt: skip
    found = solved(rows, survey)
    assert found.status == "inconsistent"
    # One degree of freedom shows that something is wrong, but not what.
    few = measured((6.0, 3.0, -2.0), survey)[:4]
    few[0] = Distance(0, 5.0, few[0].point, few[0].fiducial, few[0].distance_m + 0.5)
    few[3] = measured((6.0, 3.0, -2.0), survey)[5]
    assert solved(few, survey).status != "ok"


@pytest.mark.long
def test_scans_make_a_pose_surer_and_its_covariance_is_right() -> None:
    rng = np.random.default_rng(4)
    survey = survey_of(sigma_m=0.02)
    total = 0.0
    for _ in range(20):
        truth = np.array([rng.uniform(2, 8), rng.uniform(2, 4.5), rng.uniform(-3.1, 3.1)])
        prior = solved(measured(truth, survey, rng), survey)
        refined = refined_by_walls(
            prior, averaged_scans(onboard(truth, ROOM, rng), 5.0), ROOM, wall_curves(ROOM)
        )
        assert refined.scans == "used", refined.note
        error = refined.pose - truth
        error[2] = (error[2] + math.pi) % (2 * math.pi) - math.pi
        total += float(error @ np.linalg.solve(refined.covariance, error))
        assert math.hypot(error[0], error[1]) < 0.003
        assert np.all(np.linalg.eigvalsh(prior.covariance - refined.covariance) > 0)
    low, high = chi2.ppf([0.001, 0.999], 60)
    assert low < total < high


def test_a_corridor_leaves_a_direction_open_and_distances_stand() -> None:
    rng = np.random.default_rng(6)
    corridor = np.array([[-500.0, 0, 500, 0], [-500, 3, 500, 3]])
    survey = survey_of()
    truth = np.array([4.0, 1.5, 0.2])
    prior = solved(measured(truth, survey, rng), survey)
    refined = refined_by_walls(
        prior, averaged_scans(onboard(truth, corridor, rng), 5.0), corridor, wall_curves(corridor)
    )
    assert refined.scans == "undetermined"
    np.testing.assert_array_equal(refined.pose, prior.pose)


def test_walls_elsewhere_disagree_and_distances_stand() -> None:
    rng = np.random.default_rng(7)
    survey = survey_of()
    truth = np.array([4.0, 2.5, 0.2])
    prior = solved(measured(truth, survey, rng), survey)
    points = averaged_scans(onboard(truth, ROOM, rng), 5.0)
    walls = ROOM + np.array([0.1, 0.05, 0.1, 0.05])
    refined = refined_by_walls(prior, points, walls, wall_curves(walls))
    assert refined.scans == "disagrees"
    assert "more than the covariances allow" in refined.note
    np.testing.assert_array_equal(refined.pose, prior.pose)
    # No readings at all about the time.
    nothing = refined_by_walls(
        prior, averaged_scans(onboard(truth, ROOM, rng), 99.0), ROOM, wall_curves(ROOM)
    )
    assert nothing.scans == "no scans"


def test_an_unsure_mount_makes_the_pose_unsure() -> None:
    rng = np.random.default_rng(8)
    survey = survey_of(sigma_m=0.05)
    truth = np.array([4.0, 2.5, 0.2])
    prior = solved(measured(truth, survey, rng), survey)
    points = averaged_scans(onboard(truth, ROOM, rng), 5.0)
    sure = refined_by_walls(prior, points, ROOM, wall_curves(ROOM))
    sigma = np.diag([0.01, 0.01, 0.005]) ** 2
    mounted = tuple(replace(one, covariance=sigma) for one in points.scanners)
    loose = points._replace(scanners=mounted)
    unsure = refined_by_walls(prior, loose, ROOM, wall_curves(ROOM))
    assert unsure.scans == "used"
    # Two mounts, each 1 cm unsure, share the pose: somewhere about 7 mm.
    assert 0.003 < math.sqrt(unsure.covariance[0, 0]) < 0.015
    assert sure.covariance[0, 0] < 0.1 * unsure.covariance[0, 0]
