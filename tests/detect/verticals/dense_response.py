"""The response of the filter of verticals at every pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.response import (
    STRIPE_ROWS,
    LineFilter,
    SingleArray,
    empty_stripe,
    line_filter,
    respond,
)
from lut import VerticalTable
from redetect.compiled import kernel


def line_response(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> SingleArray:
    """The response along the verticals of a table.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        Widths of the filter, regulariser.

    Returns
    -------
    (H, W) float32
        At (v, c) that of row v of the vertical that crosses the horizon at column c: in [-1, 1],
        positive where the image is brighter on the right; 0 where it is not defined.
    """
    column = np.ascontiguousarray(table.column.T)
    return _respond_everywhere(np.ascontiguousarray(image), column, line_filter(settings)).T


@kernel()
def _respond_everywhere(
    image: NDArray[np.uint8], column: SingleArray, window: LineFilter
) -> SingleArray:
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
