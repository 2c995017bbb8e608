"""The calibration of a run."""

from __future__ import annotations

from pathlib import Path

from camera import Camera, read_camera
from redetect.slam.errors import SlamError


def camera_of_run(run: Path, camera: Path | None = None) -> Camera:
    """Read the calibration that belongs to a run.

    Parameters
    ----------
    run : Path
        Run folder, or a file in one.
    camera : Path, optional
        The calibration; by default the one ``.cam`` in the folder, ``<run>.cam`` if there are
        several.

    Returns
    -------
    Camera

    Raises
    ------
    SlamError
        If there is none, or it is not clear which.
    camera.CameraError
        If the file is malformed.
    """
    if camera is not None:
        return read_camera(camera)
    folder = run if run.is_dir() else run.parent
    found = sorted(folder.glob("*.cam"))
    own = folder / f"{folder.resolve().name}.cam"
    if len(found) > 1 and own not in found:
        names = ", ".join(path.name for path in found)
        raise SlamError(f"{folder}: several calibrations ({names}): expected one by --camera")
    if not found:
        raise SlamError(
            f"{folder}: no calibration: expected a .cam file in it, or one by --camera; `camera "
            "calibrate` makes one, `camera convert` brings one over from other programs"
        )
    return read_camera(own if own in found else found[0])
