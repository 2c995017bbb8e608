"""The pose on the floor from circles: their images' middles are not the images of their middles."""

from __future__ import annotations

import math

import numpy as np
import pytest

from camera import Camera
from camera.boards.board import Board
from camera.calibration.adjustment import Estimate, Points, circle_shifts
from camera.calibration.floor import on_floor, place_on_floor
from camera.commands.floor import describe_pose
from camera.errors import CalibrationError
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
    away_m = [np.linalg.norm(p.camera.centre - camera.centre) for p in (naive, found)]
    assert away_m[0] > 2e-3
    # The file's rotation has six digits.
    assert away_m[1] < 2e-5
    assert found.fit.rms_px < 0.1 * naive.fit.rms_px


def test_places_that_contradict_the_camera_are_told(published_camera: Camera) -> None:
    camera = published_camera
    rng = np.random.default_rng(6)
    floor_xy = rng.uniform([-0.8, -2.5], [0.8, -0.8], size=(12, 2))
    pixels = camera.project_floor(floor_xy) + rng.normal(scale=0.2, size=floor_xy.shape)
    right = place_on_floor(camera, pixels, floor_xy)
    assert right.warnings == ()
    wrong = pixels.copy()
    wrong[3] += (40.0, 30.0)
    found = place_on_floor(camera, wrong, floor_xy)
    (told,) = found.warnings
    assert f"at pixel {wrong[3, 0]:.1f}, {wrong[3, 1]:.1f}, by 5" in told
    assert told in describe_pose(found)
    # One point of twelve pulls less than its share.
    away = found.camera.centre - right.camera.centre
    assert np.all(np.abs(away) < 3.0 * np.sqrt(np.diag(found.covariance)[:3]))
    with pytest.raises(CalibrationError, match="outside of the calibrated camera's 768 x 288"):
        place_on_floor(camera, pixels * [1.0, 2.0], floor_xy)
