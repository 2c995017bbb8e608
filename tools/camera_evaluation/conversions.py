"""Converting a camera to the other programs' models and back, and cameras with Brown's terms.

Example: python -m tools.camera_evaluation conversions images/e/e.cam
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from tyro.conf import Positional

from camera import read_camera
from camera.calibration.projection import pixel_grid, projection_difference
from camera.commands.convert import MODELS
from camera.formats.conversion import Rows, convert_to_camera, convert_to_foreign
from camera.formats.models import ForeignCamera, Model
from camera.model import Camera


def _square(*distortion: float) -> ForeignCamera:
    k1, k2, p1, p2, k3 = distortion
    return ForeignCamera("radtan", 640, 480, 500.0, 500.0, 319.5, 239.5, (k1, k2, p1, p2, k3))


#: OpenCV's plumb bob: k1 k2 p1 p2 k3; the last three as published with EuRoC's cam0, KITTI's raw
#: data (camera 0) and TUM's fr1.
PLUMB_BOBS: dict[str, ForeignCamera] = {
    "tangential alone": _square(0.0, 0.0, 5e-3, 5e-3, 0.0),
    "mild, radial": _square(-0.2, 0.05, 0.0, 0.0, 0.0),
    "mild": _square(-0.2, 0.05, 2e-3, -3e-3, 0.0),
    "mild, large p": _square(-0.2, 0.05, 5e-3, 5e-3, 0.0),
    "strong, radial": _square(-0.3, 0.1, 0.0, 0.0, 0.0),
    "strong, large p": _square(-0.3, 0.1, 5e-3, 5e-3, 0.0),
    "wavy, radial": _square(0.1, -0.2, 0.0, 0.0, 0.05),
    "wavy, large p": _square(0.1, -0.2, 5e-3, 5e-3, 0.05),
    "KITTI": ForeignCamera(
        "radtan", 1392, 512, 984.2439, 980.8141, 690.0, 233.1966,
        (-0.3728755, 0.2037299, 0.002219027, 0.001383707, -0.07233722),
    ),
    "EuRoC": ForeignCamera(
        "radtan", 752, 480, 458.654, 457.296, 367.215, 248.375,
        (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0),
    ),
    "TUM fr1": ForeignCamera(
        "radtan", 640, 480, 517.306408, 516.469215, 318.64304, 255.313989,
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Convert a camera to each model and back; then OpenCV's plumb bob.

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
    decentred()
    return 0


def decentred() -> None:
    """OpenCV's k1 k2 p1 p2 k3 to a .cam file, and on to two of the other programs' models."""
    print("plumb bob         p1 p2 move   to .cam  on to radtan  on to rational (px)")
    models: tuple[Model, ...] = ("radtan", "rational")
    for name, camera in PLUMB_BOBS.items():
        k1, k2, _, _, k3 = camera.distortion
        without = replace(camera, distortion=(k1, k2, 0.0, 0.0, k3))
        rays = camera.undistort(pixel_grid(camera.width, camera.height))
        moved = np.linalg.norm(camera.distort(rays) - without.distort(rays), axis=1).max()
        there = convert_to_camera(camera)
        on = [convert_to_foreign(there.camera, model) for model in models]
        print(
            f"{name:16s} {moved:11.2f} {there.deviation_px:9.2g} {on[0].deviation_px:13.2g} "
            f"{on[1].deviation_px:13.2g}",
            flush=True,
        )
