"""The quality of possible centres of discs, and where it is highest.

Both functions say the same: one as a map, the other only its peaks above a threshold, and sooner.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from detect.circle_kernels import centres_above, quality_map, working_memory
from detect.errors import FrameError
from detect.maxima_kernels import maxima
from detect.settings import Polarity
from lut import DiscTable
from lut.kernels import BLOCK

FloatArray = NDArray[np.float64]

_Ints = NDArray[np.int32]
_Bytes = NDArray[np.uint8]
_Arguments = tuple[_Bytes, int, NDArray[Any], NDArray[np.int64], _Ints, _Ints, _Ints, _Bytes]

#: Room for so many centres above the threshold at a time.
_ROOM = 4096


def best_centres(
    image: NDArray[np.uint8], table: DiscTable, threshold: float, polarity: Polarity = "any"
) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.float32]]:
    """Local maxima of the quality: the peaks of `quality_of_centres`, without the map.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    table : DiscTable
        The camera's table.
    threshold : float
        Least quality, above 0, at most 1.
    polarity : {"any", "light", "dark"}
        Centres of another polarity count as quality 0: they hide no maximum next to them.

    Returns
    -------
    pixels : (N, 2) int64
        Pixels (u, v) that none of their 8 neighbours exceeds, in scan order. Connected pixels of
        equal quality are one maximum, at the one nearest to their centroid.
    quality : (N,) float64
    contrast : (N,) float32
        As in `quality_of_centres`.

    Raises
    ------
    FrameError
        If the image does not belong to the table.
    """
    sign = {"any": 0.0, "light": 1.0, "dark": -1.0}[polarity]
    arguments = _kernel_arguments(image, table)
    memory = working_memory(table.samples)
    parts: list[tuple[NDArray[Any], ...]] = []
    block, blocks = 0, len(table.block_row)
    while block < blocks or not parts:
        columns, rows = np.empty(_ROOM, np.int64), np.empty(_ROOM, np.int64)
        quality, contrast = np.empty(_ROOM), np.empty(_ROOM, np.float32)
        block, count = centres_above(
            *arguments, threshold, sign, *memory, block, columns, rows, quality, contrast
        )
        parts.append((columns[:count], rows[:count], quality[:count], contrast[:count]))
    columns, rows, quality, contrast = (
        parts[0] if len(parts) == 1 else (np.concatenate(values) for values in zip(*parts))
    )
    index = maxima(columns, rows, quality)
    return np.stack([columns[index], rows[index]], axis=-1), quality[index], contrast[index]


def quality_of_centres(
    image: NDArray[np.uint8], table: DiscTable
) -> tuple[FloatArray, NDArray[np.float32]]:
    """Otsu's quality, and the contrast, of the outlines around every pixel.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    table : DiscTable
        The camera's table.

    Returns
    -------
    quality : (H, W) float64
        Between-class variance / total variance of the outlines' grey values, 0 to 1; 0 where the
        table has no usable centre.
    contrast : (H, W) float32
        Mean grey value of the inner outline minus that of the outer.

    Raises
    ------
    FrameError
        If the image does not belong to the table.
    """
    arguments = _kernel_arguments(image, table)
    quality = np.zeros(image.shape)
    contrast = np.zeros(image.shape, np.float32)
    quality_map(*arguments, *working_memory(table.samples), quality, contrast)
    return quality, contrast


def _kernel_arguments(image: NDArray[np.uint8], table: DiscTable) -> _Arguments:
    """The image's pixels, with the zeros that the table wants behind them, and the table."""
    expected = table.floor_xy.shape[:2]
    if image.shape != expected or image.dtype != np.uint8:
        raise FrameError(
            f"the image is {image.dtype} of shape {image.shape}: the table is for uint8 of shape "
            f"{expected}"
        )
    pixels = np.empty(image.size + BLOCK, np.uint8)
    pixels[: image.size].reshape(image.shape)[...] = image
    pixels[image.size :] = 0
    return (
        pixels,
        table.samples,
        table.copies,
        table.block_copies,
        table.block_row,
        table.block_column,
        table.block_pattern,
        table.patterns,
    )
