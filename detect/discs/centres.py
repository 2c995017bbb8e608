"""The quality of possible centres of discs, and where it is highest.

Both functions say the same: one as a map, the other only its peaks above a threshold, and sooner.
"""

from __future__ import annotations

import threading
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.discs.maxima_kernels import highest
from detect.discs.quality_kernels import centres_above, quality_map, working_memory
from detect.errors import FrameError
from detect.settings import Polarity
from lut import DiscTable
from lut.kernels import BLOCK

FloatArray = NDArray[np.float64]

_Ints = NDArray[np.int32]
_Bytes = NDArray[np.uint8]
_Arguments = tuple[_Bytes, int, NDArray[Any], NDArray[np.int64], _Ints, _Ints, _Ints, _Bytes]

_SIGNS: dict[Polarity, float] = {"any": 0.0, "light": 1.0, "dark": -1.0}

#: Capacity for centres above the threshold, at a time.
_ROOM = 4096


class Votes(NamedTuple):
    """Which centres count although their quality is low: where the grey value steps all round."""

    step: int
    """Pairs of samples vote if they differ by more than this, grey levels, below 255."""
    least: int
    """Centres with at least this number of votes count; 0: none does."""


NO_VOTES = Votes(0, 0)


class Centres(NamedTuple):
    """Some centres, in scan order.

    Attributes
    ----------
    pixels : (N, 2) int64
        Pixels (u, v).
    quality : (N,) float64
    contrast : (N,) float32
        As in `quality_of_centres`. Where votes alone count, the contrast has their sign.
    score : (N,) float64
        The quality; where votes alone count their share of all, scaled to less than the threshold.
    """

    pixels: NDArray[np.int64]
    quality: FloatArray
    contrast: NDArray[np.float32]
    score: FloatArray


def best_centres(
    image: NDArray[np.uint8],
    table: DiscTable,
    threshold: float,
    polarity: Polarity = "any",
    rank: NDArray[np.int64] | None = None,
) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.float32]]:
    """Local maxima of the quality: the pixels, quality and contrast of `scored_centres`."""
    return scored_centres(image, table, threshold, polarity, rank)[:3]


def scored_centres(
    image: NDArray[np.uint8],
    table: DiscTable,
    threshold: float,
    polarity: Polarity = "any",
    rank: NDArray[np.int64] | None = None,
    votes: Votes = NO_VOTES,
) -> Centres:
    """Local maxima of the score: the peaks of `quality_of_centres`, without the map.

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
    rank : (H,) int64, optional
        Of each row of the image: rows whose ranks differ by 1 are neighbours. By default each row
        is the neighbour of the next one.
    votes : Votes
        What else counts.

    Returns
    -------
    Centres
        Pixels that none of their 8 neighbours exceeds, in scan order. Connected pixels of equal
        score are one maximum, at the one nearest to their centroid.

    Raises
    ------
    FrameError
        If the image does not belong to the table.
    """
    rank = _all_rows(len(image)) if rank is None else rank
    found = _good_centres(image, table, threshold, polarity, votes)
    return Centres(*highest(*found, len(found[0]), rank))


def good_centres(
    image: NDArray[np.uint8], table: DiscTable, threshold: float, polarity: Polarity = "any"
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray, NDArray[np.float32]]:
    """All centres whose quality reaches a threshold, in scan order.

    Parameters, and errors, as of `best_centres`.

    Returns
    -------
    columns, rows : (N,) int64
    quality : (N,) float64
    contrast : (N,) float32
        As in `quality_of_centres`. Until the calling thread asks again: then they change.
    """
    return _good_centres(image, table, threshold, polarity, NO_VOTES)[:4]


def _good_centres(
    image: NDArray[np.uint8], table: DiscTable, threshold: float, polarity: Polarity, votes: Votes
) -> tuple[
    NDArray[np.int64], NDArray[np.int64], FloatArray, NDArray[np.float32], NDArray[np.float64]
]:
    """`good_centres` with those that votes add, and the scores."""
    sign = _SIGNS[polarity]
    space = _working_space(image.size, table.samples)
    arguments = _kernel_arguments(image, table, space.pixels)
    buffers = space.columns, space.rows, space.quality, space.contrast, space.score
    full: list[tuple[NDArray[Any], ...]] = []
    block, count = 0, 0
    while True:
        block, count = centres_above(
            *arguments, threshold, sign, votes.step, votes.least, space.votes, *space.memory, block,
            space.columns, space.rows, space.quality, space.contrast, space.score,
        )  # fmt: skip
        if block == len(table.block_row):
            break
        full.append(tuple([values[:count].copy() for values in buffers]))
    if full:
        full.append(tuple([values[:count] for values in buffers]))
        columns, rows, quality, contrast, score = (np.concatenate(values) for values in zip(*full))
        return columns, rows, quality, contrast, score
    return (
        space.columns[:count],
        space.rows[:count],
        space.quality[:count],
        space.contrast[:count],
        space.score[:count],
    )


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
    pixels = np.zeros(image.size + BLOCK, np.uint8)
    arguments = _kernel_arguments(image, table, pixels)
    quality = np.zeros(image.shape)
    contrast = np.zeros(image.shape, np.float32)
    quality_map(*arguments, *working_memory(table.samples), quality, contrast)
    return quality, contrast


@lru_cache(maxsize=4)
def _all_rows(height: int) -> NDArray[np.int64]:
    return np.arange(height)


class _WorkingSpace(NamedTuple):
    """What `best_centres` works in: memory that is new for every image has to be fetched first."""

    pixels: _Bytes
    memory: tuple[_Bytes, NDArray[np.uint16], NDArray[np.uint32]]
    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    quality: FloatArray
    contrast: NDArray[np.float32]
    score: FloatArray
    votes: _Bytes


_kept = threading.local()


def _working_space(size: int, samples: int) -> _WorkingSpace:
    """The calling thread's working space for images of a size."""
    if getattr(_kept, "key", None) != (size, samples):
        _kept.key = None
        _kept.space = _WorkingSpace(
            np.zeros(size + BLOCK, np.uint8),
            working_memory(samples),
            np.empty(_ROOM, np.int64),
            np.empty(_ROOM, np.int64),
            np.empty(_ROOM),
            np.empty(_ROOM, np.float32),
            np.empty(_ROOM),
            np.empty(2 * BLOCK, np.uint8),
        )
        _kept.key = size, samples
    space: _WorkingSpace = _kept.space
    return space


def _kernel_arguments(
    image: NDArray[np.uint8], table: DiscTable, pixels: NDArray[np.uint8]
) -> _Arguments:
    """The image's pixels, with the zeros that the table wants behind them, and the table.

    `pixels` are as many as the image's, and those zeros: where the table refers to them, they
    become the image's.
    """
    expected = table.floor_xy.shape[:2]
    if image.shape != expected or image.dtype != np.uint8:
        raise FrameError(
            f"the image is {image.dtype} of shape {image.shape}: the table is for uint8 of shape "
            f"{expected}"
        )
    first = table.first_source
    pixels[first : image.size] = image.reshape(-1)[first:]
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
