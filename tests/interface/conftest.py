"""The demo run's first images, with and without reference rows."""

from __future__ import annotations

from pathlib import Path

import pytest

from camera import Camera


@pytest.fixture(scope="session")
def demo(project_root: Path) -> Path:
    return project_root / "images" / "e"


@pytest.fixture(scope="session")
def demo_camera(demo: Path) -> Camera:
    return Camera.read(demo / "e.cam")


@pytest.fixture(scope="session")
def demo_image(demo: Path) -> Path:
    return min((demo / "images").iterdir())
