"""What is logged beside the scans: odometry, poses from markers, truth, distances."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.groundtruth.validation.fiducials import Distance, Survey
from redetect.landmarks import wrap_angle
from tools.simulator.laser.measuring import compose
from tools.simulator.laser.session import SessionPlan
from tools.simulator.laser.site import FIDUCIALS, ROOM_M
from tools.simulator.laser.wheels import measured_path

FloatArray = NDArray[np.float64]

#: How long before and after each visit scans are logged, and the odometry if its log pauses.
SCAN_MARGIN_S = 2.0
LOG_MARGIN_S = 5.0

_CAMERAS = np.array([[0.3, 0.4], [9.6, 7.1]])
_NEAREST_FIDUCIALS = 4


def exact_poses(plan: SessionPlan, times_s: FloatArray) -> PlanarPoses:
    """True poses at times of the ground truth's clock, headings in (-pi, pi]."""
    poses = plan.route.poses(times_s)
    poses[:, 2] = wrap_angle(poses[:, 2])
    return PlanarPoses(times_s, poses)


def in_visits(plan: SessionPlan, times_s: FloatArray, margin_s: float) -> NDArray[np.bool_]:
    """Which times lie within a visit or a margin round it."""
    within = np.zeros(len(times_s), dtype=bool)
    for begin, end in plan.visits:
        within |= (times_s >= begin - margin_s) & (times_s <= end + margin_s)
    return within


def odometry_stream(plan: SessionPlan) -> PlanarPoses:
    """Odometry by the robot's clock."""
    settings, rng = plan.settings, plan.random("odometry")
    route = plan.route
    times = plan.clock.ticks(
        route.start_s, route.end_s, 1.0 / settings.odometry_hz, float(rng.random())
    )
    path = measured_path(route.poses(times), settings.wheels, rng)
    path[:, 2] = wrap_angle(path[:, 2])
    logged = np.ones(len(times), dtype=bool)
    if settings.pause_log:
        logged = in_visits(plan, times, LOG_MARGIN_S)
    return PlanarPoses(plan.clock.robot_times(times)[logged], path[logged])


def camera_stream(plan: SessionPlan) -> PlanarPoses:
    """Poses from markers with the covariances from which their errors are drawn."""
    settings, rng = plan.settings, plan.random("camera")
    period = 1.0 / settings.camera_hz
    times = np.arange(plan.route.start_s + period * rng.random(), plan.route.end_s, period)
    exact = plan.route.poses(times)
    covariances = camera_covariances(exact)
    root = np.linalg.cholesky(covariances)
    noise = np.einsum("nij,nj->ni", root, rng.standard_normal((len(times), 3)))
    seen = (rng.random(len(times)) >= settings.camera_misses) & in_visits(plan, times, 0.0)
    faults = plan.settings.faults
    lost_s = times - plan.visits[0][0] - faults.lost_camera_at_s
    seen &= ~((lost_s >= 0.0) & (lost_s < faults.lost_camera_s))
    poses = exact + noise
    poses[:, 2] = wrap_angle(poses[:, 2])
    return PlanarPoses(times[seen], poses[seen], covariances[seen])


def camera_covariances(poses: FloatArray) -> FloatArray:
    """(N, 3, 3) covariances of poses from two cameras: worse along a camera's ray, and far away."""
    information = np.zeros((len(poses), 2, 2))
    for camera in _CAMERAS:
        ray = poses[:, :2] - camera
        far = np.linalg.norm(ray, axis=1)
        unit = ray / far[:, None]
        outer = unit[:, :, None] * unit[:, None, :]
        deep, wide = (0.02 * far) ** 2, (0.006 * far) ** 2
        spread = deep[:, None, None] * outer + wide[:, None, None] * (np.eye(2) - outer)
        information += np.linalg.inv(spread + 0.02**2 * np.eye(2))
    covariances = np.zeros((len(poses), 3, 3))
    covariances[:, :2, :2] = np.linalg.inv(information)
    covariances[:, 2, 2] = np.deg2rad(0.6) ** 2
    # What turns the robot in the image also moves it aside.
    middle = poses[:, :2] - 0.5 * np.array(ROOM_M)
    joint = np.column_stack([0.001 * middle[:, 1], -0.001 * middle[:, 0],
                             np.full(len(poses), np.deg2rad(0.4))])  # fmt: skip
    return np.asarray(covariances + joint[:, :, None] * joint[:, None, :])


def reference_times(plan: SessionPlan) -> FloatArray:
    """(R,) when the distances are measured: the middle of each stand."""
    return np.array([0.5 * (begin + end) for begin, end in plan.references])


def survey_of(plan: SessionPlan) -> Survey:
    """The fiducials of the room and three points on the robot."""
    outline = plan.robot.outline
    left = outline[np.argmax(outline[:, 0] + 10.0 * outline[:, 1])]
    right = left * [1.0, -1.0]
    back = np.array([outline[:, 0].min(), 0.0])
    points = {"left": left, "right": right, "back": back}
    fiducials = {name: np.array(point) for name, point in FIDUCIALS.items()}
    return Survey(fiducials, points, plan.settings.distance_sigma_m)


def measured_distances(plan: SessionPlan) -> list[Distance]:
    """Distances of three robot points to the nearest fiducials, at every reference pose."""
    survey, rng = survey_of(plan), plan.random("distances")
    names = list(survey.fiducials)
    places = np.stack([survey.fiducials[name] for name in names])
    rows = []
    for pose, time in enumerate(reference_times(plan)):
        robot = plan.route.poses(np.array([time]))
        near = np.argsort(np.linalg.norm(places - robot[0, :2], axis=1))[:_NEAREST_FIDUCIALS]
        for point, offset in survey.robot_points.items():
            world = compose(robot, np.array([[*offset, 0.0]]))[0, :2]
            for i in sorted(near):
                far = float(np.linalg.norm(places[i] - world)) + rng.normal(0.0, survey.sigma_m)
                rows.append(Distance(pose, float(time), point, names[i], max(float(far), 0.0)))
    return rows
