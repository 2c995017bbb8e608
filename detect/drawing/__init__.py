"""Detections drawn into their images; here, the names of the pictures.

The detectors are not loaded.
"""

from __future__ import annotations

from pathlib import Path

from detect.sources.image_files import image_name
from detect.sources.interface import Frames
from redetect.storage import demand_free


def picture_name(prefix: str) -> str:
    """Name of an image's picture without its ending, which cannot lead out of a folder."""
    return image_name(prefix) or "frame"


def demand_pictures(frames: Frames, folder: Path, *, overwrite: bool) -> None:
    """Make the folder for pictures of frames; reject existing pictures if names are known now."""
    folder.mkdir(parents=True, exist_ok=True)
    if not frames.ships_images:
        names = (picture_name(frame.step.prefix) for frame in frames)
        demand_free((folder / f"{name}.png" for name in names), overwrite=overwrite)
