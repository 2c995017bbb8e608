"""The pose on the floor from circles: their images' middles are not the images of their middles."""

from __future__ import annotations

import math

import numpy as np

from camera import Camera
from camera.boards.board import Board
from camera.calibration.adjustment import Estimate, Points, circle_shifts
from camera.calibration.floor import on_floor, place_on_floor
from camera.uncertainty import intrinsics_of


def test_circles_on_the_floor_are_seen_through_perspective(published_camera: Camera) -> None:
    camera = published_camera
    board = Board("asymmetric-circles", 4, 11, 0.1, circle_m=0.12)
    floor = on_floor(board.points, (0.0, -1.6), math.pi)
    centres = camera.project_floor(floor[:, :2])
    R = camera.camera_from_robot
    truth = Estimate(intrinsics_of(camera), R[None], (-R @ camera.centre)[None])
    points = Points(
        floor, centres, np.zeros(len(floor), dtype=np.int64), camera.width, camera.height
    )
    seen = centres + circle_shifts(truth, points, 0.06)
    naive = place_on_floor(camera, seen, floor[:, :2])
    found = place_on_floor(camera, seen, floor[:, :2], radius_m=0.06)
    away_m = [np.linalg.norm(p.robot_from_camera[:, 3] - camera.centre) for p in (naive, found)]
    assert away_m[0] > 2e-3
    # The file's rotation has six digits.
    assert away_m[1] < 2e-5
    assert found.rms_px < 0.1 * naive.rms_px
