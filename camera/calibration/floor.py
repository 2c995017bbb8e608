"""The pose of a calibrated camera from known points on the floor.

The board's placement defines the robot's axes: its middle is at (X, Y) of the robot frame (X left,
Y backward, Z up), its x axis rotated from the robot's X axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from camera.calibration.adjustment import Adjusted, Points, adjust, fit_to_centres, project_estimate
from camera.calibration.calibrate import largest_rms_px
from camera.calibration.model import COUNT
from camera.calibration.start import best_poses, board_poses
from camera.errors import CalibrationError
from camera.model import Camera, points_on_floor
from camera.rotations import cross_matrices
from camera.uncertainty import covariance_of, intrinsics_of, with_covariance, with_pose
from redetect.array_types import FloatArray
from redetect.storage.bounded import rows_of_numbers

_FEWEST_POINTS = 4
#: Prior of the noise of a coordinate, pixels, and its degrees of freedom.
_PRIOR_PX, _PRIOR_FREEDOM = 0.15, 3


@dataclass(frozen=True, eq=False)
class FloorPose:
    """A camera placed in the robot frame."""

    camera: Camera  # with the joint covariance of lens and pose, if that of the lens is known
    # (6, 6): of the position (m, robot frame) and of a small rotation from the left (rad, about the
    # robot's axes), in this order; errors of the points and of the intrinsics.
    covariance: FloatArray
    fit: Adjusted  # the adjusted view, with its residuals
    warnings: tuple[str, ...] = ()


def on_floor(board_points: FloatArray, origin_xy: tuple[float, float], yaw: float) -> FloatArray:
    """(N, 3) positions in the robot frame of a board's (N, 3) points, its middle at `origin_xy`.

    `yaw` (rad) is from the robot's X axis to the board's, counterclockwise seen from above.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    turned = board_points @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
    return np.asarray(turned + np.array([*origin_xy, 0.0]))


def place_on_floor(
    camera: Camera,
    pixels: FloatArray,
    floor_xy: FloatArray,
    radius_m: float = 0.0,
) -> FloorPose:
    """The camera's pose from points on the floor.

    Takes `pixels` (N, 2), `floor_xy` (N, 2), and the radius of circles there, 0 for points.
    """
    floor = points_on_floor(floor_xy)
    _check(pixels, floor, (camera.width, camera.height))
    points = Points(floor, pixels, np.zeros(len(floor), np.int64), camera.width, camera.height)
    start = board_poses(intrinsics_of(camera), points)[0]
    # Not robust with few points: four, for example, leave too few residuals to find outliers.
    adjusted = partial(adjust, span=np.zeros((COUNT, 0)), robust=len(floor) > 8)
    try:
        fit, _ = fit_to_centres(adjusted, best_poses(start, points), points, radius_m)
    except ValueError:
        raise CalibrationError(
            "no pose of the camera sees the floor's points where they are: are they in the order "
            "u, v, x, y, with X to the left and Y backward, and is it this camera's calibration?"
        ) from None
    estimate = fit.estimate
    R, t = estimate.rotations[0].T, -estimate.rotations[0].T @ estimate.translations[0]
    if t[2] <= 0.0:
        raise CalibrationError(
            "the points are seen from below the floor: X and Y are mirrored (X is to the left, Y "
            "backward, Z up), or the board lies with its print down"
        )
    # From (rotation from the left in the camera frame, translation) of camera_from_robot.
    # R' = R exp(-w), t' = -R exp(-w) (T + dT): dt = -R dT + R (w x T).
    to_pose = np.zeros((6, 6))
    to_pose[:3, 3:] = -R
    to_pose[:3, :3] = -R @ cross_matrices(estimate.translations[0])
    to_pose[3:, :3] = -R
    _, pixels_by_intrinsics, pixels_by_pose = project_estimate(estimate, points)
    gain = np.linalg.pinv(pixels_by_pose.reshape(-1, 6)) @ pixels_by_intrinsics.reshape(-1, COUNT)
    by_intrinsics = -to_pose @ gain
    # The noise that few points show is vague: with its prior, the variance's posterior mean.
    freedom = 2 * len(pixels) - 6
    variance = freedom * fit.sigma_px**2 + _PRIOR_FREEDOM * _PRIOR_PX**2
    variance /= freedom + _PRIOR_FREEDOM - 2
    covariance = to_pose @ fit.pose_covariances[0] @ to_pose.T * (variance / fit.sigma_px**2)
    placed = with_pose(camera, np.column_stack([R, t]))
    if (known := covariance_of(camera)) is not None:
        lens = known[:COUNT, :COUNT]
        both = by_intrinsics @ lens
        covariance = covariance + both @ by_intrinsics.T
        placed = with_covariance(placed, np.block([[lens, both.T], [both, covariance]]))
    warnings = []
    if fit.rms_px > largest_rms_px(camera.width):
        away = np.linalg.norm(fit.residuals, axis=1)
        u, v = pixels[np.argmax(away)].tolist()
        warnings.append(
            f"an RMS residual of {fit.rms_px:.2f} px means that the points do not fit (the "
            f"worst, at pixel {u:.1f}, {v:.1f}, by {away.max():.1f} px): are all points right, "
            "is the floor flat, and is it this camera's calibration?"
        )
    return FloorPose(placed, covariance, fit, tuple(warnings))


def read_floor_points(path: Path) -> tuple[FloatArray, FloatArray]:
    """(N, 2) pixels and (N, 2) floor places of a CSV file with the header ``u,v,x,y``."""
    rows = rows_of_numbers(path, "file of floor points", "u v x y", CalibrationError, head=True)
    table = np.array([numbers for _, numbers in rows], dtype=np.float64).reshape(-1, 4)
    return table[:, :2], table[:, 2:]


def _check(pixels: FloatArray, floor: FloatArray, size: tuple[int, int]) -> None:
    if len(pixels) < _FEWEST_POINTS:
        raise CalibrationError(
            f"{len(pixels)} points on the floor: at least {_FEWEST_POINTS} are needed, better 10 "
            "and more over all of the floor that is seen"
        )
    outside = np.any((pixels < -0.5) | (pixels > np.array(size) - 0.5), axis=1)
    if outside.any():
        u, v = pixels[outside][0].tolist()
        raise CalibrationError(
            f"pixel {u:g}, {v:g} is outside of the calibrated camera's {size[0]} x {size[1]}: are "
            "the points of pictures of this size?"
        )
    for what, values in (("on the floor", floor[:, :2]), ("in the image", pixels)):
        away = values - values.mean(axis=0)
        spreads = np.linalg.eigvalsh(
            # Leaving out one point at a time.
            away.T @ away - len(away) / (len(away) - 1) * away[:, :, None] * away[:, None, :]
        )
        if np.any(spreads[:, 0] < 1e-6 * spreads[:, 1]):
            raise CalibrationError(
                f"all points, or all but one, lie in a line {what}: add others beside it, or the "
                "camera's tilt about the line stays open"
            )
