"""Runs of some frames of the demo run, to be spoilt, interrupted and detected again."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path


def demo_frames(project_root: Path, run: Path, numbers: Iterable[int]) -> Path:
    """A run of these frames of the demo run, called by their places: e.0000, e.0001 ..."""
    source = project_root / "images" / "e"
    (run / "images").mkdir(parents=True)
    shutil.copy(source / "e.cam", run)
    for place, number in enumerate(numbers):
        image = source / "images" / f"e.{number:04d}.jpg"
        shutil.copy(image, run / "images" / f"e.{place:04d}.jpg")
    return run
