"""``camera convert``: calibrations from and to other programs' formats."""

from __future__ import annotations

import numpy as np

from camera.errors import ConversionError
from camera.formats import files
from camera.formats.models import ForeignCamera
from camera.model import Camera
from camera.options import Convert
from camera.uncertainty import coarse_pixel_grid
from redetect.storage import demand_place, write_bytes

#: Rays farther off the axis, degrees, are beyond the model of ``.cam`` files.
_WIDEST_DEG = 80.0


def perform(options: Convert) -> int:
    """Execute the command; returns the exit code."""
    demand_place(options.target, overwrite=options.force)
    text = files.read_text(options.source)
    from_format = files.format_of_text(options.source, text)
    to_format = files.format_of_name(options.target)
    source = files.parse(text, from_format, str(options.source), options.camera_name)
    try:
        converted = files.convert(source, to_format, options)
    except ConversionError as error:
        raise ConversionError(f"{options.source}: {error}") from None
    camera = converted.camera
    label = camera.model if isinstance(camera, ForeignCamera) else _label(camera)
    u, v = converted.at
    print(
        f"{options.source} ({from_format}, {source.width} x {source.height}) to {to_format} "
        f"({label}, {camera.width} x {camera.height}): largest deviation over the image "
        f"{converted.deviation_px:.3g} px, at ({u:.0f}, {v:.0f})"
    )
    if not converted.deviation_px <= options.limit_px:
        advice = "choose another --model or format, or raise the limit"
        if isinstance(camera, Camera):
            rays = source.undistort(coarse_pixel_grid(source.width, source.height))
            if (off := float(np.degrees(np.arctan(np.nanmax(np.hypot(*rays.T)))))) > _WIDEST_DEG:
                advice = (
                    f"the lens sees {off:.0f} degrees off its axis, {_WIDEST_DEG:g} of which .cam "
                    "files describe well: crop its images"
                )
        raise ConversionError(
            f"{options.target}: not written, since {converted.deviation_px:.3g} px is above "
            f"--limit-px {options.limit_px:g}: {advice}"
        )
    if isinstance(camera, Camera) and camera.seen_share < 1.0:
        unseen = 100.0 * (1.0 - camera.seen_share)
        print(f"{unseen:.1f} % of the image, past the distortion's fold, see nothing")
    if isinstance(camera, Camera) and not isinstance(source, Camera) and options.pose_from is None:
        print(
            "no pose: sensor2World is the identity; give --pose-from, or let `camera floor` find it"
        )
    if isinstance(source, Camera) and not isinstance(camera, Camera):
        print("the pose is dropped: the format has none (--pose-from restores it)")
    if getattr(source, "covariance", None) and not getattr(camera, "covariance", None):
        print("the covariance is dropped: it is kept in .cam files of the same rows and pose")
    written = files.FORMATS[to_format].format(camera)
    write_bytes(options.target, written.encode(), overwrite=options.force)
    print(f"written: {options.target}")
    return 0


def _label(camera: Camera) -> str:
    """Name of a camera's distortion model, with its terms."""
    if not any(camera.brown):
        return "rational radial"
    parts = {
        "rational radial": any(camera.coef[:2]),
        "polynomial": any(camera.polynomial),
        "tangential": camera.decentred,
    }
    return ", ".join(name for name, there in parts.items() if there)
