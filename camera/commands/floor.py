"""``camera floor``: the pose of a calibrated camera from known points on the floor."""

from __future__ import annotations

from math import degrees, radians
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from camera.boards.board import board_of
from camera.boards.points import find_board
from camera.calibration.floor import FloorPose, on_floor, place_on_floor, read_floor_points
from camera.calibration.pictures import drawn_floor, rectified_floor
from camera.camfile import read_camera, write_camera
from camera.errors import CalibrationError
from camera.model import Camera
from camera.options import Floor
from redetect.array_types import FloatArray
from redetect.bounds import FINITE, demand
from redetect.storage import demand_place, write_bytes
from redetect.storage.images import read_grey


def perform(options: Floor) -> int:
    """Execute the command; returns the exit code."""
    demand(options, CalibrationError, floor_origin=FINITE, floor_yaw=FINITE)
    demand_place(options.output, overwrite=options.force)
    camera = read_camera(options.camera)
    pixels, floor_xy, radius_m = floor_points(options, (camera.width, camera.height))
    placed = place_on_floor(camera, pixels, floor_xy, radius_m)
    print(describe_pose(placed))
    if placed.camera.covariance is None:
        print("the .cam file has no covariance of the lens: that of the pose is not written")
    write_floor_pictures(options, placed.camera)
    write_camera(placed.camera, options.output, overwrite=options.force)
    print(f"written: {options.output}")
    return 0


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
    if board.is_symmetric:
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
    places = on_floor(board.points[indices], options.floor_origin, radians(options.floor_yaw))
    return pixels, places[:, :2], 0.5 * board.circle_m


def describe_pose(pose: FloorPose) -> str:
    """The pose with its standard deviations, for people."""
    sigma, fit = np.sqrt(np.diag(pose.covariance)), pose.fit
    R, t = pose.camera.rotation, pose.camera.centre
    down = degrees(np.arcsin(np.clip(-R[2, 2], -1.0, 1.0)))
    bearing = degrees(np.arctan2(R[0, 2], -R[1, 2]))
    axes = ("X (left)    ", "Y (backward)", "Z (up)      ")
    return "\n".join(
        [
            f"pose from {len(fit.residuals)} points on the floor, RMS {fit.rms_px:.3f} px:",
            *(f"  {axis} {value:9.5f} m +- {s:.5f}" for axis, value, s in zip(axes, t, sigma)),
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
