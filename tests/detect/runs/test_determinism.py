"""The same image gives the same bytes, wherever arrays lie in memory and code comes from."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera import read_camera
from detect.circles import detect_circles, disc_shape
from detect.lines import detect_lines
from detect.markers.detect import detect_markers
from detect.markers.settings import MarkerSettings
from detect.settings import CircleSettings
from lut import build_disc_table, build_vertical_table

Image = NDArray[np.uint8]


def _bytes(found: object) -> bytes:
    """All arrays of a result."""
    assert dataclasses.is_dataclass(found)
    values = (getattr(found, field.name) for field in dataclasses.fields(found))
    return b"".join(value.tobytes() for value in values if isinstance(value, np.ndarray))


def _detector(project_root: Path, kind: str) -> tuple[Path, Callable[[Image], bytes]]:
    if kind == "markers":
        lens = read_camera(project_root / "images" / "m" / "a" / "a.cam")
        settings = MarkerSettings(dictionary="rawseeds")
        return project_root / "images" / "m" / "a" / "images", lambda image: repr(
            detect_markers(image, settings, lens).landmarks()
        ).encode()
    folder = project_root / "images" / "e" / "images"
    camera = read_camera(project_root / "images" / "e" / "e.cam")
    if kind == "lines":
        verticals = build_vertical_table(camera)
        return folder, lambda image: _bytes(detect_lines(image, verticals))
    discs = build_disc_table(camera, disc_shape(CircleSettings()))
    return folder, lambda image: _bytes(detect_circles(image, camera, discs, CircleSettings()))


def _is_compiled(project_root: Path) -> bool:
    """Whether discs' kernels were compiled before, some of them at least."""
    cached = (project_root / "detect" / "discs" / "__pycache__").glob("*.nbc")
    return "NUMBA_CACHE_DIR" in os.environ or any(cached)


@pytest.mark.long
def test_compiled_now_or_before_discs_are_the_same(project_root: Path, tmp_path: Path) -> None:
    # A kernel that is called by others exists several times, optimised among different code: which
    # of them runs depends on what was compiled in the same process. So those whose order of adding
    # is up to the compiler (fastmath) have to be part of their callers.
    environment = dict(os.environ)
    if _is_compiled(project_root):
        environment["NUMBA_CACHE_DIR"] = str(tmp_path / "kernels")
    # Else they are compiled where all other tests need them: once, not twice, in a new clone, where
    # this file comes first (tests/conftest.py).
    found, said = [], []
    for turn in ("compiled", "loaded"):
        output = tmp_path / f"{turn}.json"
        done = subprocess.run(
            [
                *(sys.executable, "-m", "detect", "circles", str(project_root / "images" / "e")),
                *("-o", str(tmp_path / f"{turn}.circles"), "--json", str(output), "--jobs", "1"),
            ],
            env=environment,
            cwd=project_root,
            check=True,
            timeout=600,
            capture_output=True,
            text=True,
        )
        found.append(output.read_bytes())
        said.append("compiling kernels" in done.stderr)
    assert said == [True, False]
    assert found[0] == found[1]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["circles", "lines", "markers"])
def test_the_same_image_gives_the_same_bytes(project_root: Path, kind: str) -> None:
    folder, detect = _detector(project_root, kind)
    rng = np.random.default_rng(3)
    for path in sorted(folder.iterdir())[:6]:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        seen = set()
        for _ in range(12):
            # What stays allocated and what is freed decides where later arrays will lie, and what
            # was there before.
            freed = [
                np.full(rng.integers(100, 400_000), rng.choice([np.nan, 1e30, 0.0, 255.0]))
                for _ in range(6)
            ]
            del freed
            kept = [np.empty(rng.integers(1, 60_000), np.uint8) for _ in range(rng.integers(9))]
            seen.add(detect(np.array(image, np.uint8)))
            assert len(kept) < 9
        assert len(seen) == 1, path.name
