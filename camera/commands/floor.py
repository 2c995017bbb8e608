"""``camera floor``: the pose of a calibrated camera with respect to the floor."""

from __future__ import annotations

from camera.calibration.floor import place_on_floor, with_pose
from camera.camfile import read_camera, write_camera
from camera.commands.calibrate import describe_pose, floor_points
from camera.errors import CalibrationError
from camera.options import Floor
from redetect.storage import OutputExistsError


def perform(options: Floor) -> int:
    """Carry the command out; returns the exit code."""
    if options.output.exists() and not options.force:
        raise OutputExistsError(options.output)
    camera = read_camera(options.camera)
    is_picture = options.floor.suffix.lower() != ".csv"
    if is_picture and 0 in (options.columns, options.rows, options.square_m):
        raise CalibrationError(
            "a picture of a board needs --columns, --rows and --square-m of the board; a .csv "
            "of places on the floor (u,v,x,y) needs none"
        )
    seen = floor_points(options, options.floor, (camera.width, camera.height))
    placed = place_on_floor(camera, seen.pixels, seen.xy, radius_m=seen.radius_m)
    print(describe_pose(placed))
    write_camera(
        with_pose(camera, placed.robot_from_camera), options.output, overwrite=options.force
    )
    print(f"written: {options.output}")
    return 0
