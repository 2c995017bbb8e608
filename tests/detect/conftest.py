"""A small run whose discs are known, and a cache of tables that is the tests' own."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from camera import Camera
from tests.detect.painted_floor import PaintedFloor

#: The discs in the three images of the small run.
SMALL_RUN_DISCS = {"s.0000": [(0.1, -1.2), (-0.5, -1.9)], "s.0001": [(0.3, -1.5)], "s.0002": []}

SMALL_RUN_STEPS = """\
# Odometry of the small run.
STEP s.0000  0.00125 -0.25000  0.01000 0.000020000000 0.000001000000 0.000030000000 0.000000100000 0.000000200000 0.000400000000
STEP s.0001 -0.00375 -0.30000 -0.02000 0.000021000000 0.000001100000 0.000031000000 0.000000110000 0.000000210000 0.000410000000
STEP s.0002  0.01000 -0.35000  0.03000 0.000022000000 0.000001200000 0.000032000000 0.000000120000 0.000000220000 0.000420000000
"""  # noqa: E501


@pytest.fixture(scope="session", autouse=True)
def own_table_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """No table that an older program left in the user's cache decides a test."""
    folder = tmp_path_factory.mktemp("tables")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("REDETECT_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def small_run_template(
    tmp_path_factory: pytest.TempPathFactory, published_camera: Camera, published_cam_text: str
) -> Path:
    folder = tmp_path_factory.mktemp("template") / "s"
    (folder / "images").mkdir(parents=True)
    (folder / "s.cam").write_text(published_cam_text)
    (folder / "s.txt").write_text(SMALL_RUN_STEPS)
    for seed, (prefix, places) in enumerate(SMALL_RUN_DISCS.items()):
        floor = PaintedFloor(published_camera)
        for place in places:
            floor.disc(place)
        assert cv2.imwrite(str(folder / "images" / f"{prefix}.png"), floor.image(seed=seed))
    return folder


@pytest.fixture
def small_run(small_run_template: Path, tmp_path: Path) -> Path:
    """A run folder of three images that may be spoilt."""
    return Path(shutil.copytree(small_run_template, tmp_path / "s"))
