"""What neighbouring frames decide, and what they leave open."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from redetect.groundtruth.markers.poses import PoseEstimate, estimate_pose
from redetect.groundtruth.markers.refinement import RefinedPose
from redetect.groundtruth.markers.track import choose_candidates
from redetect.groundtruth.settings import PoseSettings
from redetect.groundtruth.trajectories import se3
from tests.groundtruth.markers.scene import hall_cameras, pose_problem
from tools.simulator.driving import planar_transform

FloatArray = NDArray[np.float64]

COVARIANCE = np.diag([0.01, 0.01, 0.01, 0.02, 0.02, 0.02]) ** 2
FLIP = se3.exp(np.array([0.0, 0.0, 0.0, 0.5, 0.3, 0.0]))


def estimate(*poses: FloatArray, odds: float = 0.5) -> PoseEstimate:
    candidates = tuple(
        RefinedPose(pose, COVARIANCE, 2.0, 2, np.ones(1), np.ones(1)) for pose in poses
    )
    views = np.ones(1, dtype=np.bool_)
    return PoseEstimate(candidates, views, tuple(odds * i for i in range(len(poses))))


def driving(i: int) -> FloatArray:
    return planar_transform(0.05 * i, 0.0, 0.02 * i)


TIMES = [0.1 * i for i in range(9)]


def test_clear_neighbours_decide_against_the_lower_cost() -> None:
    estimates = [estimate(driving(i)) for i in range(9)]
    for i in (3, 4, 5):
        estimates[i] = estimate(driving(i) @ FLIP, driving(i))
    choices = choose_candidates(TIMES, estimates, PoseSettings())
    assert [c.candidate for c in choices] == [0, 0, 0, 1, 1, 1, 0, 0, 0]
    assert [c.status for c in choices] == ["clear"] * 3 + ["resolved"] * 3 + ["clear"] * 3
    assert all(c.margin > np.log(1000) for c in choices)


def test_without_a_clear_neighbour_it_stays_open() -> None:
    """Many frames that lean the same way are no proof: their errors go together."""
    still = planar_transform(1.0, 2.0, 0.3)
    estimates = [estimate(still, still @ FLIP) for _ in range(9)]
    choices = choose_candidates(TIMES, estimates, PoseSettings())
    assert {c.status for c in choices} == {"unresolved"}
    assert {c.candidate for c in choices} == {0}
    assert all(c.margin == pytest.approx(0.5) for c in choices)


def test_a_frame_that_fits_nowhere_is_rejected_and_a_carried_robot_is_not() -> None:
    estimates = [estimate(driving(i)) for i in range(9)]
    estimates[4] = estimate(driving(4) @ FLIP)
    choices = choose_candidates(TIMES, estimates, PoseSettings())
    assert [c.status for c in choices] == ["clear"] * 4 + ["rejected"] + ["clear"] * 4
    carried = [estimate(driving(i) if i < 4 else planar_transform(5.0, 5.0, 2.0)) for i in range(9)]
    assert {c.status for c in choose_candidates(TIMES, carried, PoseSettings())} == {"clear"}


def test_the_first_and_the_last_frame_can_be_wrong_too() -> None:
    for wrong in (0, 8):
        estimates = [estimate(driving(i)) for i in range(9)]
        estimates[wrong] = estimate(driving(wrong) @ FLIP)
        choices = choose_candidates(TIMES, estimates, PoseSettings())
        assert [i for i, c in enumerate(choices) if c.status == "rejected"] == [wrong]


def test_a_pause_leaves_room_for_driving_but_not_for_tilting() -> None:
    """Reference poses minutes apart: where it stands says nothing, that it stands level does."""
    estimates = [estimate(planar_transform(3.0 * i, 0.0, 1.0 * i)) for i in range(4)]
    there = planar_transform(-2.0, 7.0, -1.0)
    estimates.insert(2, estimate(there @ FLIP, there))
    choices = choose_candidates([0.0, 60.0, 120.0, 180.0, 240.0], estimates, PoseSettings())
    assert choices[2].candidate == 1
    assert choices[2].status == "resolved"


def test_one_frame_and_none() -> None:
    settings = PoseSettings()
    assert choose_candidates([], [], settings) == []
    (choice,) = choose_candidates([0.0], [estimate(np.eye(4))], settings)
    assert (choice.candidate, choice.status) == (0, "clear")


def test_a_frontal_marker_between_views_of_several() -> None:
    """Rendered corners: the robot turns a single far marker to the camera and away again."""
    generator = np.random.default_rng(31)
    camera = hall_cameras(1)[0]
    bearing = float(np.arctan2(camera[1, 3] - 1.5, camera[0, 3] - 1.5))
    settings = PoseSettings()
    truths, estimates = [], []
    for i in range(15):
        truth = planar_transform(1.5, 1.5, bearing + 0.06 * (i - 7))
        pairs = [(0, 0)] if abs(i - 7) < 3 else [(0, 0), (0, 1), (0, 4)]
        problem = pose_problem(
            truth, cameras=1, pairs=pairs, noise=generator, sigma_px=0.3, scale_px=500.0,
            settings=settings,
        )  # fmt: skip
        truths.append(truth)
        estimates.append(estimate_pose(problem))
    assert sum(e.ambiguous for e in estimates[5:10]) >= 3
    choices = choose_candidates([0.1 * i for i in range(15)], estimates, settings)
    for truth, each, choice in zip(truths, estimates, choices):
        assert choice.status in ("clear", "resolved")
        assert choice.candidate is not None
        pose = each.candidates[choice.candidate].world_from_robot
        assert np.degrees(np.arccos(pose[:3, 2] @ truth[:3, 2])) < 8.0
