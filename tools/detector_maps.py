"""Maps of a whole image: quality of every centre, response of every pixel.

Pages show and time them, and tests compare them with plain implementations; the detectors compute
only what they need.
"""

from __future__ import annotations

import numpy as np

from detect.discs.quality import Limits, centres_of
from detect.line_settings import LineSettings
from detect.verticals.response import STRIPE_ROWS, LineFilter, empty_stripe, line_filter, respond
from lut import DiscTable, VerticalTable
from redetect.array_types import Float32Array, FloatArray, GreyImage
from redetect.compiled import kernel


def quality_of_centres(image: GreyImage, table: DiscTable) -> tuple[FloatArray, Float32Array]:
    """(H, W) Otsu's quality of the outlines around every centre of a table, and their contrast.

    The quality is the between-class variance of the grey values over the total variance, 0 where
    the table has no centre; the contrast is the mean grey value of the inner outline minus that of
    the outer.
    """
    centres = centres_of(image, table, Limits(quality=0.0))
    u, v = centres.pixels.T
    quality, contrast = np.zeros(image.shape), np.zeros(image.shape, np.float32)
    quality[v, u], contrast[v, u] = centres.quality, centres.contrast
    return quality, contrast


def line_response(image: GreyImage, table: VerticalTable, settings: LineSettings) -> Float32Array:
    """(H, W) responses in an image (H, W) along the verticals of its camera's table.

    The response at (v, c) is that in row v of the vertical that crosses the horizon at column c: in
    [-1, 1], positive if the image is brighter on the right; 0 where it is not defined.
    """
    column = np.ascontiguousarray(table.column.T)
    return _respond_everywhere(np.ascontiguousarray(image), column, line_filter(settings)).T


@kernel()
def _respond_everywhere(image: GreyImage, column: Float32Array, window: LineFilter) -> Float32Array:
    width, height = column.shape
    stripe = empty_stripe(window)
    response = np.zeros((width, height), np.float32)
    for c in range(width):
        for top in range(0, height, STRIPE_ROWS):
            for i in range(len(stripe.path)):
                v = top - window.half_length + i
                stripe.path[i] = column[c, v] if 0 <= v < height else np.nan
            respond(image, top, stripe)
            for v in range(top, min(top + STRIPE_ROWS, height)):
                response[c, v] = stripe.response[v - top, stripe.middle]
    return response
