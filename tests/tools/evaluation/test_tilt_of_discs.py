"""The tilt by discs of a map: what tilted the camera comes back, beside a row of another disc."""

from __future__ import annotations

import numpy as np
import pytest

from camera import Camera
from detect.projection import level_positions
from tools.evaluation.tilt_of_discs import tilt_of_discs

POSE = np.array([2.0, -1.0, 0.7])
TILT = (-0.031, 0.012)
SEEN = np.array([(0.4, -1.2), (-0.6, -1.6), (0.1, -2.1), (0.9, -2.8), (-0.8, -3.1), (0.2, -3.9)])


def scene(camera: Camera, raised_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows that the tilted camera gives, and where their discs are in the map."""
    level = level_positions(camera, SEEN, TILT, raised_m)
    cosine, sine = np.cos(POSE[2]), np.sin(POSE[2])
    return SEEN, POSE[:2] + level @ np.array([[cosine, sine], [-sine, cosine]])


@pytest.mark.parametrize("raised_m", [0.0, -0.045])
def test_tilt_comes_back(published_camera: Camera, raised_m: float) -> None:
    rows_xy, map_xy = scene(published_camera, raised_m)
    found = tilt_of_discs(published_camera, rows_xy, map_xy, POSE + 0.02, raised_m)
    np.testing.assert_allclose(found.angles, TILT, atol=2e-6)


def test_a_row_of_another_disc_hardly_counts(published_camera: Camera) -> None:
    rows_xy, map_xy = scene(published_camera, 0.0)
    map_xy[3] += (0.3, -0.2)
    found = tilt_of_discs(published_camera, rows_xy, map_xy, POSE)
    off = found.angles - TILT
    assert np.abs(off).max() < 0.004
    # And the covariance says that something is wrong.
    assert off @ np.linalg.solve(found.covariance, off) < 9.0
