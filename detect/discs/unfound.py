"""Why no discs are found in some images: how many candidates there are, and what they fail."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.circles import disc_shape
from detect.discs.candidates import strong_and_alone
from detect.discs.quality import Limits, centres_of
from detect.noise import estimate_noise
from detect.settings import CircleSettings
from lut import cached_disc_table


def why_none(images: Sequence[NDArray[np.uint8]], camera: Camera, settings: CircleSettings) -> str:
    """Sentences on the candidates for discs in images (H, W) without any, and what they fail."""
    table = cached_disc_table(camera, disc_shape(settings))
    signs = {"any": (-1, 1), "light": (1,), "dark": (-1,)}[settings.polarity]
    found = faint = other_sign = 0
    for image in images:
        centres = centres_of(image, table, Limits(settings.threshold))
        best = strong_and_alone(centres, table.floor_xy, 0.0, 0.5 * settings.separation_m)
        contrast = centres.contrast[best]
        signed = np.isin(np.sign(contrast), signs)
        least = settings.noise_floor * max(estimate_noise(image), 1.0)
        found += len(best)
        other_sign += int((~signed).sum())
        faint += int((signed & (np.abs(contrast) < least)).sum())
    if not found:
        return (
            f"There is no candidate in {len(images)} of the images: no place has a quality of "
            f"{settings.threshold:g} (--threshold)."
        )
    fates = (
        (other_sign, f"are not {settings.polarity} (--polarity any)"),
        (faint, f"have a contrast of less than {settings.noise_floor:g} times the noise "
         "(--noise-floor)"),
        (found - other_sign - faint, "do not look like a disc when one is fitted (--evidence)"),
    )  # fmt: skip
    failed = ", ".join(f"{count} {test}" for count, test in fates if count)
    return f"Of {found} candidates in {len(images)} of the images {failed}."
