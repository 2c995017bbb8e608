"""``camera floor``: the pose of a calibrated camera from known points on the floor.

The board's placement defines the robot's axes: its middle is at (X, Y) of the robot frame (X left,
Y backward, Z up), its x axis rotated from the robot's X axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from math import degrees, radians
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from camera.boards.board import board_of
from camera.boards.points import find_board
from camera.calibration.adjustment import Adjusted, Points, adjust, fit_to_centres, project_estimate
from camera.calibration.calibrate import largest_rms_px
from camera.calibration.model import COUNT
from camera.calibration.pictures import drawn_floor, rectified_floor
from camera.calibration.start import best_poses, board_poses
from camera.camfile import read_camera, write_camera
from camera.errors import CalibrationError
from camera.model import Camera
from camera.options import Floor
from camera.rotations import cross_matrices
from camera.uncertainty import covariance_of, intrinsics_of, with_covariance, with_pose
from redetect.array_types import FloatArray
from redetect.bounds import FINITE, demand
from redetect.storage import demand_place, write_bytes
from redetect.storage.bounded import rows_of_numbers
from redetect.storage.images import read_grey

_FEWEST_POINTS = 4


def perform(options: Floor) -> int:
    """Execute the command; returns the exit code."""
    demand(options, CalibrationError, floor_origin=FINITE, floor_yaw=FINITE)
    demand_place(options.output, overwrite=options.force)
    camera = read_camera(options.camera)
    pixels, floor_xy, radius_m = floor_points(options, (camera.width, camera.height))
    known = covariance_of(camera)
    lens = None if known is None else known[:COUNT, :COUNT]
    placed = place_on_floor(camera, pixels, floor_xy, lens, radius_m)
    print(describe_pose(placed))
    if lens is None:
        print("the .cam file has no covariance of the lens: that of the pose is not written")
    camera = placed_camera(camera, placed, lens)
    write_floor_pictures(options, camera)
    write_camera(camera, options.output, overwrite=options.force)
    print(f"written: {options.output}")
    return 0


@dataclass(frozen=True, eq=False)
class FloorPose:
    """The camera's pose in the robot frame."""

    robot_from_camera: FloatArray  # (3, 4)
    # (6, 6): of the position (m, robot frame) and of a small rotation from the left (rad, about the
    # robot's axes), in this order; errors of the points and of the intrinsics.
    covariance: FloatArray
    by_intrinsics: FloatArray  # (6, 14): how the pose follows errors of the intrinsics
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
    intrinsics_covariance: FloatArray | None = None,
    radius_m: float = 0.0,
) -> FloorPose:
    """The camera's pose from points on the floor.

    Takes `pixels` (N, 2), `floor_xy` (N, 2), `intrinsics_covariance` (14, 14).
    """
    floor = np.column_stack([floor_xy, np.zeros(len(floor_xy))])
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
    covariance = to_pose @ fit.pose_covariances[0] @ to_pose.T
    if intrinsics_covariance is not None:
        covariance = covariance + by_intrinsics @ intrinsics_covariance @ by_intrinsics.T
    warnings = []
    if fit.rms_px > largest_rms_px(camera.width):
        away = np.linalg.norm(fit.residuals, axis=1)
        u, v = pixels[np.argmax(away)].tolist()
        warnings.append(
            f"an RMS residual of {fit.rms_px:.2f} px means that the points do not fit (the "
            f"worst, at pixel {u:.1f}, {v:.1f}, by {away.max():.1f} px): are all points right, "
            "is the floor flat, and is it this camera's calibration?"
        )
    return FloorPose(np.column_stack([R, t]), covariance, by_intrinsics, fit, tuple(warnings))


def placed_camera(
    camera: Camera, pose: FloorPose, intrinsics_covariance: FloatArray | None
) -> Camera:
    """The camera at a pose, with the covariance of both if that of its lens is known."""
    camera = with_pose(camera, pose.robot_from_camera)
    if intrinsics_covariance is None:
        return replace(camera, covariance=None)
    both = pose.by_intrinsics @ intrinsics_covariance
    return with_covariance(
        camera, np.block([[intrinsics_covariance, both.T], [both, pose.covariance]])
    )


def floor_points(options: Floor, size: tuple[int, int]) -> tuple[FloatArray, FloatArray, float]:
    """Points on the floor of a .csv file, or of a picture of the board.

    Returns `pixels` (N, 2), places `floor_xy` (N, 2) (robot X, Y in m), and the radius of the
    circles seen there (m), 0 for points.
    """
    path = options.floor
    if path.suffix.lower() == ".csv":
        return *read_floor_points(path), 0.0
    if 0 in (options.columns, options.rows, options.square_m):
        raise CalibrationError(
            "a picture of a board needs --columns, --rows and --square-m of the board; a .csv "
            "of places on the floor (u,v,x,y) needs none"
        )
    board = board_of(options)
    if board.looks_turned:
        raise CalibrationError(
            f"a {board} looks the same turned by 180 degrees, so it can't say where the robot's "
            "axes point: use one with one even and one odd number, or a .csv of places u,v,x,y"
        )
    image = read_grey(path, CalibrationError)
    if image.shape != size[::-1]:
        raise CalibrationError(
            f"{path}: {image.shape[1]} x {image.shape[0]} pixels: expected the calibrated camera's "
            f"{size[0]} x {size[1]}"
        )
    try:
        indices, pixels = find_board(image, board)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None
    yaw = radians(options.floor_yaw)
    places = on_floor(board.points[indices], options.floor_origin, yaw)
    return pixels, places[:, :2], 0.5 * board.circle_m


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


def describe_pose(pose: FloorPose) -> str:
    """The pose with its standard deviations, for people."""
    sigma, fit = np.sqrt(np.diag(pose.covariance)), pose.fit
    R, t = pose.robot_from_camera[:, :3], pose.robot_from_camera[:, 3]
    down = degrees(np.arcsin(np.clip(-R[2, 2], -1.0, 1.0)))
    bearing = degrees(np.arctan2(R[0, 2], -R[1, 2]))
    return "\n".join(
        [
            f"pose from {len(fit.residuals)} points on the floor, RMS {fit.rms_px:.3f} px:",
            *(
                f"  {axis} {value:9.5f} m +- {s:.5f}"
                for axis, value, s in zip(
                    ("X (left)    ", "Y (backward)", "Z (up)      "), t, sigma
                )
            ),
            f"  looking {down:.3f} deg down, {bearing:.3f} deg to the left; rotations about X, "
            f"Y, Z +- {', '.join(f'{degrees(s):.4f}' for s in sigma[3:])} deg",
            "  covariance (X Y Z in m, rotations about X Y Z in rad):",
            *(f"    {' '.join(f'{value: .3e}' for value in row)}" for row in pose.covariance),
            *(f"warning: {text}" for text in pose.warnings),
        ]
    )


def write_floor_pictures(options: Floor, camera: Camera) -> None:
    """The floor's grid in its photograph, and the floor from above; of a table, nothing."""
    floor = options.floor
    if options.pictures is None:
        return
    if floor.suffix.lower() == ".csv":
        print(f"{floor}: no photograph, so there is no picture of the floor's grid")
        return
    image = read_grey(floor, CalibrationError)
    for name, draw in (("grid", drawn_floor), ("from-above", rectified_floor)):
        place = options.pictures / f"{floor.name}.{name}.png"
        write_picture(draw(image, camera), place, force=options.force)


def write_picture(picture: NDArray[np.uint8], place: Path, *, force: bool) -> None:
    """Write a PNG file, its folder if need be."""
    place.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(place, cv2.imencode(".png", picture)[1].tobytes(), overwrite=force)
    print(f"written: {place}")
