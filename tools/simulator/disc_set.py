"""Many single discs in one file, for Monte Carlo tests outside Python's process."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera import Camera, parse_camera, read_camera
from redetect.storage import write_whole
from tools.simulator.observation import BORDER_PX, FAR_LIMIT_M
from tools.simulator.plan import PUBLISHED_CAMERA
from tools.simulator.scene import FloatArray
from tools.simulator.single_disc import render_disc

# Zip entries carry a date; a constant one makes the same discs the same bytes.
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)


def random_floor_places(camera: Camera, count: int, rng: np.random.Generator) -> FloatArray:
    """Places on the floor, evenly spread over the part of the image where rows may lie.

    Parameters
    ----------
    camera : Camera
        The camera.
    count : int
        How many.
    rng : numpy Generator
        Draws them.

    Returns
    -------
    (count, 2) array
        Robot X, Y in metres: wholly in front of the camera, at least 12 px inside the image, and no
        farther than the floor moves 0.05 m from one pixel to the next.
    """
    found: list[FloatArray] = []
    low = np.full(2, float(BORDER_PX))
    high = np.array([camera.width, camera.height]) - 1.0 - BORDER_PX
    while len(found) < count:
        pixel = rng.uniform(low, high)
        jacobian = camera.floor_jacobian(pixel)
        if not np.isnan(jacobian).any() and np.linalg.norm(jacobian, 2) <= FAR_LIMIT_M:
            found.append(camera.floor_from_pixel(pixel))
    return np.array(found)


def write_discs(
    path: Path,
    camera_file: Path | None,
    *,
    count: int,
    seed: int,
    radius_m: float,
    blur_px: tuple[float, float],
    noise_sigma: float,
    row_aperture: float,
    overwrite: bool,
) -> None:
    """Render discs at random places and write them with their truth as ``.npz``.

    The arrays are ``grey_0000`` and so on (the crops), ``u0_v0`` (their offsets), ``floor_xy`` (m)
    and ``pixel`` (where the centres are seen). Parameters as in
    `tools.simulator.single_disc.render_disc`.
    """
    if camera_file is None:
        camera = parse_camera(PUBLISHED_CAMERA, "the published calibration")
    else:
        camera = read_camera(camera_file)
    rng = np.random.default_rng(seed)
    places = random_floor_places(camera, count, rng)
    arrays: dict[str, NDArray[Any]] = {}
    offsets = []
    for k, floor_xy in enumerate(places):
        crop = render_disc(
            camera, floor_xy, radius_m, blur_px=blur_px, noise_sigma=noise_sigma, rng=rng,
            row_aperture=row_aperture,
        )  # fmt: skip
        arrays[f"grey_{k:04d}"] = crop.grey
        offsets.append((crop.u0, crop.v0))
    arrays["u0_v0"] = np.array(offsets)
    arrays["floor_xy"] = places
    arrays["pixel"] = camera.project_floor(places)
    with write_whole(path, overwrite=overwrite) as stream, zipfile.ZipFile(stream, "w") as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", _ZIP_DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w") as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
