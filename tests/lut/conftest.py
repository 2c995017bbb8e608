"""A camera and an outline of few samples: tables in milliseconds."""

from __future__ import annotations

import dataclasses

import pytest

from camera import Camera
from lut import DiscShape

SHAPE = DiscShape(samples=5, border_px=3, far_limit_m_per_px=0.2)


@pytest.fixture
def camera(published_camera: Camera) -> Camera:
    """The published camera at an eighth of its size."""
    return dataclasses.replace(
        published_camera, width=96, height=36, scale_x=464.762 / 8, scale_y=232.381 / 8,
        offset_x=48.0, offset_y=18.0,
    )  # fmt: skip
