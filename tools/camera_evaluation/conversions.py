"""Converting a camera to the other programs' models and back.

Example: python -m tools.camera_evaluation conversions images/e/e.cam
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tyro.conf import Positional

from camera import read_camera
from camera.calibration_projection import projection_difference
from camera.conversion import Rows, convert_to_camera, convert_to_foreign
from camera.convert_command import MODELS
from camera.model import Camera


@dataclass(frozen=True)
class Options:
    """Convert a camera to each model and back.

    Example: python -m tools.camera_evaluation conversions images/e/e.cam

    Parameters
    ----------
    camera : Path
        The camera.
    """

    camera: Positional[Path]


def main(arguments: list[str]) -> int:
    """Run the study."""
    options = tyro.cli(Options, prog="conversions", args=arguments)
    camera = read_camera(options.camera)
    print("model      rows    there (px)  back (px)   there and back against the camera (px)")
    ways: list[tuple[Rows, Rows]] = [("same", "same"), ("double", "halve")]
    for model in MODELS["opencv"]:
        for out, home in ways:
            there = convert_to_foreign(camera, model, out)
            back = convert_to_camera(there.camera, home)
            assert isinstance(back.camera, Camera)
            whole = np.nanmax(projection_difference(camera, back.camera, rotate=False))
            print(
                f"{model:10s} {out:7s} {there.deviation_px:9.5f} {back.deviation_px:10.5f} "
                f"{whole:12.5f}"
            )
    return 0
