"""``camera floor``: the pose of a calibrated camera with respect to the floor."""

from __future__ import annotations

from camera.boards.board import Board
from camera.calibration.floor import place_on_floor, read_floor_points, with_pose
from camera.camfile import read_camera, write_camera
from camera.commands.calibrate import describe_pose, floor_points, radius_on_floor
from camera.errors import CalibrationError
from camera.options import Floor
from storage import OutputExistsError


def perform(options: Floor) -> int:
    """Carry the command out; returns the exit code."""
    if options.output.exists() and not options.force:
        raise OutputExistsError(options.output)
    camera = read_camera(options.camera)
    radius_m = 0.0
    if options.floor.suffix.lower() == ".csv":
        pixels, floor_xy = read_floor_points(options.floor)
    else:
        if options.columns == 0 or options.rows == 0 or options.square_m == 0.0:
            raise CalibrationError(
                "a picture of a board needs --columns, --rows and --square-m of the board; a .csv "
                "of places on the floor (u,v,x,y) needs none"
            )
        board = Board(
            kind=options.board,
            columns=options.columns,
            rows=options.rows,
            square_m=options.square_m,
            marker_m=options.marker_m,
            dictionary=options.dictionary,
            circle_m=options.circle_m,
        )
        radius_m = radius_on_floor(options.floor, board)
        size = (camera.width, camera.height)
        pixels, floor_xy = floor_points(
            options.floor, board, options.floor_origin, options.floor_yaw, size
        )
    placed = place_on_floor(camera, pixels, floor_xy, radius_m=radius_m)
    print(describe_pose(placed))
    write_camera(
        with_pose(camera, placed.robot_from_camera), options.output, overwrite=options.force
    )
    print(f"written: {options.output}")
    return 0
