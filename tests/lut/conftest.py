"""A camera and an outline of few samples: tables in milliseconds."""

from __future__ import annotations

import hashlib
import io

import numpy as np
import pytest

from camera import Camera
from lut import DiscShape
from tools.benchmark.material import scaled_camera

SHAPE = DiscShape(samples=5, border_px=3, far_limit_m_per_px=0.2)


def archive(**arrays: object) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def signed(payload: bytes, name: str) -> bytes:
    """Content of a file of this name that is as sound as a hash can tell."""
    return hashlib.sha256(name.encode() + b"\0" + payload).digest() + payload


@pytest.fixture
def camera(published_camera: Camera) -> Camera:
    """The published camera at an eighth of its size."""
    return scaled_camera(published_camera, 1 / 8)
