"""A kernel is compiled for one kind of array, wherever cameras and tables come from.

Built, read from a file, or handed over by another process, arrays differ in whether they may be
written to and in how they lie in memory; for each kind Numba would compile again, for seconds, in a
user's second run.
"""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import typeof

from camera import Camera, parse_camera
from detect.circles import CircleDetections, refined_covariance
from detect.discs.positions import refined_covariances
from detect.levelling import levelled
from lut import DiscShape, cached_disc_table, cached_vertical_table
from redetect.landmarks import FrameTilt
from tools.benchmark.material import scaled_camera
from tools.published_camera import PUBLISHED_CAM

FLOOR_XY = np.array([[0.0, -1.0], [1.1, -2.0]])
COVARIANCE = np.stack([1e-4 * np.eye(2)] * 2)


def kinds_of(table: Any) -> dict[str, str]:
    return {
        field.name: str(typeof(getattr(table, field.name))) for field in dataclasses.fields(table)
    }


@pytest.mark.parametrize("kind", ["discs", "verticals"])
def test_tables_that_are_built_and_read_are_of_one_kind(
    published_camera: Camera, tmp_path: Path, kind: str
) -> None:
    def table() -> Any:
        camera = scaled_camera(published_camera, 1 / 8)  # tables in milliseconds
        if kind == "verticals":
            return cached_vertical_table(camera, folder=tmp_path)
        return cached_disc_table(
            camera, DiscShape(samples=5, border_px=3, far_limit_m_per_px=0.2), folder=tmp_path
        )

    built = kinds_of(table())
    assert len(list(tmp_path.iterdir())) == 1
    assert kinds_of(table()) == built


def test_cameras_that_are_read_and_handed_over_are_of_one_kind() -> None:
    read = parse_camera(PUBLISHED_CAM)
    assert read.centre[2] > 0.0  # kept by the camera, and handed over with it
    assert read.rotation.shape == (3, 3)
    handed_over = pickle.loads(pickle.dumps(read))
    kernels: tuple[Any, ...] = (refined_covariances,)
    pixels, two = np.array([[400, 200], [300, 150]]), np.ones(2)
    discs = CircleDetections(pixels, FLOOR_XY, COVARIANCE, two, two)
    tilt = FrameTilt("e.0000", 0.01, 0.02, 1e-6, 0.0, 1e-6, 9)
    compiled = []
    for camera in (read, handed_over):
        levelled(discs, camera, tilt)
        refined_covariance(camera, FLOOR_XY, COVARIANCE, 0.002, 0.005)
        compiled.append([set(kernel.signatures) for kernel in kernels])
    assert compiled[0] == compiled[1]
