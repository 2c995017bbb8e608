"""A drawn marker, for compiling the detector's kernels before there is an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detect.markers.settings import MarkerSettings
from detect.markers.templates import templates_of

_CELL_PX = 5
_MARGIN_PX = 20


def specimen_image(settings: MarkerSettings) -> NDArray[np.uint8]:
    """A grey image of one of the expected markers on white, seen from the front."""
    templates = templates_of(settings.dictionary, settings.ids)
    widths = np.diff(templates.lines) / templates.dictionary.cell
    pixels = np.maximum(1, np.rint(widths * _CELL_PX)).astype(np.intp)
    black = np.repeat(np.repeat(templates.blackness(0), pixels, axis=0), pixels, axis=1)
    grey = np.where(np.pad(black, _MARGIN_PX) > 0.5, 40.0, 200.0)
    # Soft edges, as all images have them: a mean over 3 x 3 pixels.
    soft = np.pad(grey, 1, mode="edge")
    height, width = grey.shape
    total = sum(soft[j : j + height, i : i + width] for j in range(3) for i in range(3))
    return np.asarray(np.rint(total / 9.0), np.uint8)
