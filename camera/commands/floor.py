"""``camera floor``: the pose of a calibrated camera with respect to the floor."""

from __future__ import annotations

from camera.calibration.floor import place_on_floor, placed_camera
from camera.calibration.model import COUNT
from camera.camfile import read_camera, write_camera
from camera.commands.calibrate import describe_pose, floor_points, write_floor_pictures
from camera.errors import CalibrationError
from camera.options import Floor
from camera.uncertainty import covariance_of
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
    seen = floor_points(options, None, options.floor, (camera.width, camera.height))
    known = covariance_of(camera)
    lens = None if known is None else known[:COUNT, :COUNT]
    placed = place_on_floor(camera, seen.pixels, seen.xy, lens, seen.radius_m)
    print(describe_pose(placed))
    if lens is None:
        print("the lens's covariance is not in the .cam file: neither will the pose's be")
    camera = placed_camera(camera, placed, lens)
    write_floor_pictures(options, options.floor, camera)
    write_camera(camera, options.output, overwrite=options.force)
    print(f"written: {options.output}")
    return 0
