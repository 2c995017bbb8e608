"""Motion of the robot: poses and tilt, a drive along a route, and odometry of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from camera import Camera
from camera.uncertainty import with_pose
from redetect.array_types import FloatArray
from redetect.groundtruth.trajectories import se3
from redetect.landmarks import Step
from redetect.plane import between


def planar_transform(x_m: float, y_m: float, theta_rad: float) -> FloatArray:
    """(4, 4) pose of a robot standing level on the floor at x, y with heading theta."""
    c, s = np.cos(theta_rad), np.sin(theta_rad)
    return se3.transform([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], [x_m, y_m, 0.0])


def tilted_camera(camera: Camera, tilt_rad: ArrayLike) -> Camera:
    """The camera of a robot tilted about its origin on the floor, relative to the level robot.
    `tilt_rad` (2,).
    """
    level_from_tilted = Rotation.from_rotvec([*np.asarray(tilt_rad), 0.0]).as_matrix()
    return with_pose(camera, level_from_tilted @ np.array(camera.robot_from_camera))


_DENSE_M = 0.01
_DENSE_RAD = 0.01
_TURNING_COST_M = 0.6  # a radian of turning takes as long as this many metres
_REVERSAL_RAD = np.radians(150.0)


@dataclass(frozen=True)
class DriveStyle:
    """How the robot drives."""

    step_m: float = 0.172  # Mean distance between frames on straight stretches (m).
    step_spread: float = 0.08  # Slow change of the speed, as a share (standard deviation).
    weave_m: float = 0.12  # Slow sideways deviation from the route (m, standard deviation).
    corner_m: float = 0.8  # Radius of rounded corners (m).
    tilt_deg: float = 0.6  # Standard deviation of pitch and roll, each (deg).
    tilt_frames: float = 6.0  # Frames over which the tilt stays similar.
    constant_tilt_deg: tuple[float, float] = (0.0, 0.0)  # Constant tilt (p, q) on top (deg).


def drive(route: ArrayLike, steps: int, style: DriveStyle, rng: np.random.Generator) -> FloatArray:
    """Drive along a route. `route` (K, 2); returns (steps + 1, 3)."""
    dense = _weaving(_rounded(np.asarray(route, dtype=np.float64), style.corner_m), style, rng)
    distance = np.hypot(*np.diff(dense[:, :2], axis=0).T)
    turn = np.abs(np.diff(dense[:, 2]))
    cost = np.concatenate([[0.0], np.cumsum(distance + _TURNING_COST_M * turn)])
    pace = style.step_m * np.exp(style.step_spread * smooth_noise(steps, 25.0, rng))
    at = np.concatenate([[0.0], np.cumsum(pace)])
    if at[-1] > cost[-1]:
        raise ValueError(
            f"the route is over after {np.searchsorted(at, cost[-1]) - 1} steps: expected {steps}"
        )
    return np.stack([np.interp(at, cost, dense[:, k]) for k in range(3)], axis=-1)


def robot_tilt(frames: int, style: DriveStyle, rng: np.random.Generator) -> FloatArray:
    """(frames, 2) tilt (p, q) of a moving robot (rad), smooth from frame to frame.

    See `tools.simulator.driving.tilted_camera` for the sign and axes.
    """
    noise = np.stack([smooth_noise(frames, style.tilt_frames, rng) for _ in range(2)], axis=-1)
    return np.asarray(np.radians(style.tilt_deg * noise + np.array(style.constant_tilt_deg)))


def smooth_noise(count: int, length: float, rng: np.random.Generator) -> FloatArray:
    """(count,) Gaussian noise of unit variance that stays similar over `length` samples."""
    margin = int(np.ceil(4.0 * length))
    white = rng.standard_normal(count + 2 * margin)
    smooth = gaussian_filter1d(white, length, mode="constant")[margin : margin + count]
    # Variance of a Gaussian-weighted mean of white noise.
    return np.asarray(smooth * np.sqrt(2.0 * length * np.sqrt(np.pi)))


def _rounded(route: FloatArray, radius: float) -> FloatArray:
    """Dense poses along the route with rounded corners and turns on the spot."""
    apart = np.hypot(*np.diff(route, axis=0).T) > 1e-9
    route = route[np.concatenate([[True], apart])]
    leg = np.diff(route, axis=0)
    length = np.hypot(*leg.T)
    unit = leg / length[:, None]
    # Heading h looks along (sin h, -cos h).
    heading = np.arctan2(unit[:, 0], -unit[:, 1])
    pieces: list[FloatArray] = []
    at, facing = route[0], float(heading[0])
    for k in range(len(leg)):
        end = route[k + 1]
        turn = 0.0
        if k + 1 < len(leg):
            turn = float(np.pi - np.mod(np.pi - (heading[k + 1] - heading[k]), 2.0 * np.pi))
        reversal = abs(turn) > _REVERSAL_RAD
        cut = 0.0
        if k + 1 < len(leg) and not reversal and abs(turn) > 1e-6:
            cut = min(radius * np.tan(0.5 * abs(turn)), 0.45 * length[k], 0.45 * length[k + 1])
        stop = end - cut * unit[k]
        pieces.append(_straight(at, stop, facing))
        if cut > 0.0:
            arc = _arc(stop, facing, turn, cut / np.tan(0.5 * abs(turn)))
            pieces.append(arc)
            at, facing = arc[-1, :2], float(arc[-1, 2])
        else:
            count = max(int(abs(turn) / _DENSE_RAD), 1)
            spin = facing + turn * np.arange(1, count + 1) / count
            pieces.append(np.column_stack([np.tile(stop, (count, 1)), spin]))
            at, facing = stop, facing + turn
    return np.concatenate(pieces)


def _straight(start: FloatArray, end: FloatArray, heading: float) -> FloatArray:
    count = max(int(np.hypot(*(end - start)) / _DENSE_M), 1)
    share = np.arange(1, count + 1)[:, None] / count
    return np.column_stack([start + share * (end - start), np.full(count, heading)])


def _arc(start: FloatArray, heading: float, turn: float, radius: float) -> FloatArray:
    count = max(int(radius * abs(turn) / _DENSE_M), 8)
    angle = heading + turn * np.arange(1, count + 1) / count
    # Along an arc of radius r, d(position) = (sin h, -cos h) r dh.
    signed = radius * np.sign(turn)
    x = start[0] + signed * (np.cos(heading) - np.cos(angle))
    y = start[1] + signed * (np.sin(heading) - np.sin(angle))
    return np.column_stack([x, y, angle])


def _weaving(dense: FloatArray, style: DriveStyle, rng: np.random.Generator) -> FloatArray:
    """Add a slow lateral offset to the path; headings stay tangential."""
    length = 1.6 / _DENSE_M
    off = style.weave_m * smooth_noise(len(dense), length, rng)
    slope = np.gradient(off) / _DENSE_M
    left = np.column_stack([np.cos(dense[:, 2]), np.sin(dense[:, 2])])
    # While the robot turns on the spot nothing is shifted: it does not move along the slope.
    moving = np.concatenate([[0.0], np.hypot(*np.diff(dense[:, :2], axis=0).T)]) > 1e-9
    woven = dense.copy()
    woven[:, :2] += off[:, None] * left
    woven[:, 2] += np.where(moving, np.arctan(slope), 0.0)
    return woven


#: Fitted to the shipped steps.
HEADING_VARIANCE_PER_M = 1.4955e-3
HEADING_VARIANCE_PER_RAD = 3.74e-4
#: Shipped steps: the ratio of the variances of heading and position is the same everywhere.
HEADING_OVER_POSITION = 18.637

_GAUSS_NODES = 4


def step_covariance(steps: ArrayLike) -> FloatArray:
    """Covariance of steps as the data set has it. `steps` (..., 3); returns (..., 3, 3)."""
    step = np.asarray(steps, dtype=np.float64)
    distance = np.hypot(step[..., 0], step[..., 1])
    heading = HEADING_VARIANCE_PER_M * distance + HEADING_VARIANCE_PER_RAD * np.abs(step[..., 2])
    position = heading / HEADING_OVER_POSITION
    covariance = np.zeros((*step.shape[:-1], 3, 3))
    covariance[..., 0, 0] = covariance[..., 1, 1] = position
    nodes, weights = np.polynomial.legendre.leggauss(_GAUSS_NODES)
    for node, weight in zip(0.5 * (nodes + 1.0), 0.5 * weights):
        # A heading error at this share of the step turns the rest of the step.
        rest_x, rest_y = _rest_of_arc(step, float(node))
        lever = np.stack([-rest_y, rest_x, np.ones_like(rest_x)], axis=-1)
        outer = lever[..., :, None] * lever[..., None, :]
        covariance += weight * heading[..., None, None] * outer
    return covariance


def _rest_of_arc(step: FloatArray, share: float) -> tuple[FloatArray, FloatArray]:
    """The rest of steps after a share of their arc, in the frame before them."""
    dphi = step[..., 2]
    # Chord of the first `share` of an arc: its direction turns back by half of what is missing.
    small = np.abs(dphi) < 1e-9
    safe = np.where(small, 1.0, dphi)
    ratio = np.where(small, share, np.sin(0.5 * share * safe) / np.sin(0.5 * safe))
    back = 0.5 * (share - 1.0) * dphi
    c, s = np.cos(back), np.sin(back)
    x = ratio * (c * step[..., 0] - s * step[..., 1])
    y = ratio * (s * step[..., 0] + c * step[..., 1])
    return step[..., 0] - x, step[..., 1] - y


def measured_steps(
    poses: ArrayLike, rng: np.random.Generator, wrong: ArrayLike | None = None
) -> FloatArray:
    """Steps as odometry measures them. `poses` (N + 1, 3); `wrong` (N,); returns (N, 3)."""
    pose = np.asarray(poses, dtype=np.float64)
    true = between(pose[:-1], pose[1:])
    root = np.linalg.cholesky(step_covariance(true) + 1e-18 * np.eye(3))
    noise = rng.standard_normal(true.shape)
    measured = true + np.einsum("nij,nj->ni", root, noise)
    if wrong is not None:
        slip = np.asarray(wrong, dtype=bool)
        measured[slip, :2] *= 1.1
        measured[slip, 2] += 0.012
    return np.asarray(measured)


def step_record(prefix: str, step: FloatArray) -> Step:
    """Row of a measured step, its covariance that of the measured movement."""
    c = step_covariance(step)
    numbers = *step, c[0, 0], c[0, 1], c[1, 1], c[0, 2], c[1, 2], c[2, 2]
    return Step(prefix, *map(float, numbers))
