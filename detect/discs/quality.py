"""The quality of every centre: how well two outlines on the floor part the grey values.

A disc centred at a pixel has an inner outline within its edge and an outer one beyond it
(`lut.outlines`). Taken as two classes, their grey values have Otsu's quality (N. Otsu, A Threshold
Selection Method from Gray-Level Histograms, 1979; DLR Spatial Cognition data set report, circle
detection): the between-class variance over the total one. With n = n_inner + n_outer samples that
vote,

    difference = n_outer sum(inner) - n_inner sum(outer)
    spread     = n sum(x^2) - (sum x)^2
    quality    = difference^2 / (n_inner n_outer spread)
    contrast   = difference / (n_inner n_outer)

All of these are whole numbers, so the only rounding is that of the one final division. Grey values
are gathered and summed by `detect.discs.gathering`, for squares products x (255 - x).

Something bright or dark beside a disc raises the total variance, and so ruins the quality, but not
the steps of the grey value from outline to outline. So, if asked to, directions vote: those in
which the inner grey value exceeds the outer one (or the other way round) by some grey levels.

The compiled loops are written so that LLVM turns them into vectors: simple indices, and NumPy's
functions in place of operators where Numba would widen numbers to 64 bits.
"""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.gathering import TILE, Turn, gather, sum_tile
from detect.errors import FrameError
from lut import DiscTable
from lut.kernels import AT_ONCE, COPIED, GROUP, PITCH

#: A centre that was found.
CENTRE = np.dtype(
    [
        ("u", np.int64),
        ("v", np.int64),
        ("quality", np.float64),
        # Of the inner outline to the outer; where votes alone count, at least the step of their
        # sign.
        ("contrast", np.float32),
        # The quality; where votes alone count their share of all, scaled to less than the
        # least quality.
        ("score", np.float64),
    ]
)

#: Comparisons of 24-bit numbers let through a little more than the exact ones that follow.
_CAUTIOUS = 1.0 - 4e-6
#: Capacity for centres at first.
_ROOM = 2048

_U8, _U64, _I32, _F32 = np.uint8, np.uint64, np.int32, np.float32
#: From one row of gathered grey values to the next.
_ROW = np.uint64(PITCH)


class Wanted(NamedTuple):
    """Which centres are found."""

    quality: float
    """At least, and above 0;"""
    contrast: float
    """and more than this, of either sign, grey levels (or 4e-6 of it less)."""
    sign: float
    """1 for those lighter than what is around them, -1 for darker ones, 0 for both."""
    step: int
    """Directions vote whose grey value steps by more than this, below 255."""
    votes: int
    """With at least this number of votes of the sign, low quality does not matter; 0: it does."""


class Blocks(NamedTuple):
    """A `lut.DiscTable` as compiled loops take it."""

    samples: int
    copies: NDArray[Any]
    bounds: NDArray[np.int64]
    row: NDArray[np.int32]
    column: NDArray[np.int32]
    stride: NDArray[np.int32]
    whole: NDArray[np.bool_]
    place: NDArray[np.int64]
    votes: NDArray[np.uint8]


class Memory(NamedTuple):
    """What is summed for the centres of a block."""

    gathered: NDArray[np.uint8]
    inner: NDArray[np.uint16]
    outer: NDArray[np.uint16]
    products: NDArray[np.uint32]
    matters: NDArray[np.uint8]
    """1 for those that may be wanted."""
    light: NDArray[np.uint8]
    dark: NDArray[np.uint8]
    """Votes."""
    lacking: NDArray[np.uint8]
    """1 for those with samples outside the image."""
    none: NDArray[np.uint8]
    """Zeros."""


@njit(cache=True, error_model="numpy", nogil=True)
def sum_and_gather(
    memory: Memory, place: int, samples: int, width: int, pixels: NDArray[np.uint8],
    blocks: Blocks, following: int, to: int,
) -> None:  # fmt: skip
    """Sums of x of both outlines, and of x (255 - x), of one block; and gather another.

    Parameters
    ----------
    memory : Memory
    place, to : int
        Where the one block's grey values begin, and the other's are to.
    samples, width : int
        Samples on each outline, and centres of the block that is summed.
    pixels, blocks
        As in `find_centres`.
    following : int
        Number of the block to be gathered; -1 for none.
    """
    fours = -(-samples // GROUP)
    tiles = -(-width // TILE)
    first, end, stride = 0, 0, 1
    if following >= 0:
        first, end = blocks.bounds[following], blocks.bounds[following + 1]
        stride = blocks.stride[following]
    each = (end - first) // (fours * tiles * AT_ONCE) * AT_ONCE
    sums = memory.inner, memory.outer, memory.products
    for tile in range(tiles):
        turn = Turn(place, fours, tile * TILE, stride, first, each, to)
        to = sum_tile(pixels, blocks.copies, memory.gathered, sums, turn)
        first += each * fours
    gather(pixels, blocks.copies, memory.gathered, stride, first, end - first, to)


@njit(cache=True, error_model="numpy", nogil=True)
def compare_whole(memory: Memory, samples: int, width: int, wanted: Wanted) -> None:
    """As `compare`, where all samples vote: their number is cancelled."""
    least = _F32(wanted.contrast * _CAUTIOUS) * _F32(samples)
    share = _F32(wanted.quality * _CAUTIOUS)
    n, white = _I32(2 * samples), _I32(2 * samples * 255)
    inner, outer, products, matters = memory.inner, memory.outer, memory.products, memory.matters
    for i in range(_U64(width)):
        a, b = _I32(inner[i]), _I32(outer[i])
        total = np.add(a, b)
        difference = _F32(np.subtract(a, b))
        spread = _F32(
            np.subtract(
                np.multiply(total, np.subtract(white, total)),
                np.multiply(n, _I32(products[i])),
            )
        )
        matters[i] = (abs(difference) > least) & (difference * difference > share * spread)


@njit(cache=True, error_model="numpy", nogil=True)
def compare(
    memory: Memory, votes: NDArray[np.uint8], place: int, width: int, wanted: Wanted
) -> None:
    """Note which centres may have the contrast and the quality wanted, in 32-bit numbers."""
    least = _F32(wanted.contrast * _CAUTIOUS)
    share = _F32(wanted.quality * _CAUTIOUS)
    of_inner, of_outer = _U64(place), _U64(place + len(votes) // 2)
    inner, outer, products, matters = memory.inner, memory.outer, memory.products, memory.matters
    for i in range(_U64(width)):
        n_inner, n_outer = _I32(votes[of_inner + i]), _I32(votes[of_outer + i])
        a, b = _I32(inner[i]), _I32(outer[i])
        n, total = np.add(n_inner, n_outer), np.add(a, b)
        white = np.multiply(_I32(255), n)
        difference = _F32(np.subtract(np.multiply(n_outer, a), np.multiply(n_inner, b)))
        # At most 256 votes: none of these exceeds 2^30.
        spread = _F32(
            np.subtract(
                np.multiply(total, np.subtract(white, total)),
                np.multiply(n, _I32(products[i])),
            )
        )
        pairs = _F32(np.multiply(n_inner, n_outer))
        matters[i] = (abs(difference) > least * pairs) & (
            difference * difference > share * pairs * spread
        )


@njit(cache=True, error_model="numpy", forceinline=True)
def _count_steps(
    gathered: NDArray[np.uint8], higher: Any, lower: Any, step: int, without: NDArray[np.uint8],
    width: Any, counts: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Count where one row of samples exceeds another, less `without`, by at least a step."""
    enough = _U8(step)
    for i in range(width):
        x = _U8(gathered[higher + i])
        # Modulo 256: what nothing is taken from stays, and zeros less 1 are exceeded by nothing.
        y = np.subtract(_U8(gathered[lower + i]), _U8(without[i]))
        more = np.subtract(np.maximum(x, y), y)
        counts[i] += more >= enough


@njit(cache=True, error_model="numpy", nogil=True)
def vote(memory: Memory, place: int, samples: int, width: int, wanted: Wanted) -> None:
    """Count the directions that vote, and note where there are enough.

    Zeros of a lacking outer outline are outside the image: nothing exceeds them (and all else is
    exceeded by one grey level more).
    """
    light, dark = memory.light, memory.dark
    light[:width] = 0
    dark[:width] = 0
    padded = -(-samples // GROUP) * GROUP
    step = wanted.step + 1
    wide = _U64(width)
    for k in range(samples):
        inner = _U64(place) + _U64(k) * _ROW
        outer = inner + _U64(padded) * _ROW
        if wanted.sign >= 0.0:
            _count_steps(memory.gathered, inner, outer, step, memory.lacking, wide, light)
        if wanted.sign <= 0.0:
            _count_steps(memory.gathered, outer, inner, step, memory.none, wide, dark)
    for i in range(wide):
        memory.matters[i] |= max(light[i], dark[i]) >= wanted.votes


@njit(cache=True, error_model="numpy", nogil=True)
def quality_of(
    inner: float, outer: float, product: float, n_inner: float, n_outer: float
) -> tuple[float, float]:
    """Quality and contrast from the sums x of both outlines, x (255 - x) of all, and the votes.

    These are whole numbers, of which nothing here exceeds 2^53.
    """
    n = n_inner + n_outer
    total = inner + outer
    spread = n * (255.0 * total - product) - total * total
    difference = n_outer * inner - n_inner * outer
    pairs = n_inner * n_outer
    quality = (difference * difference) / (pairs * spread)
    contrast = difference / pairs
    return quality if spread > 0.0 else 0.0, contrast if pairs > 0.0 else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _judge(
    memory: Memory, i: int, n_inner: int, n_outer: int, samples: int, wanted: Wanted, centre: Any
) -> bool:
    """Quality, contrast and score of a centre, and whether it is wanted."""
    quality, contrast = quality_of(
        float(memory.inner[i]), float(memory.outer[i]), float(memory.products[i]),
        float(n_inner), float(n_outer),
    )  # fmt: skip
    centre.quality = centre.score = quality
    centre.contrast = contrast
    if quality >= wanted.quality and quality > 0.0 and contrast * wanted.sign >= 0.0:
        return True
    if wanted.votes == 0 or n_inner == 0:
        return False
    by_light = memory.light[i] >= wanted.votes
    count = memory.light[i] if by_light else memory.dark[i]
    least = wanted.step + 1.0
    centre.contrast = max(contrast, least) if by_light else min(contrast, -least)
    centre.score = wanted.quality / (samples + 1.0) * count
    return bool(count >= wanted.votes)


@njit(cache=True, error_model="numpy", nogil=True)
def memory_for(samples: int) -> Memory:
    """Memory for a block."""
    rows = 2 * -(-samples // GROUP) * GROUP
    return Memory(
        np.empty(2 * (rows * PITCH + COPIED), np.uint8),
        np.empty(PITCH, np.uint16),
        np.empty(PITCH, np.uint16),
        np.empty(PITCH, np.uint32),
        np.zeros(PITCH, np.uint8),
        np.zeros(PITCH, np.uint8),
        np.zeros(PITCH, np.uint8),
        np.zeros(PITCH, np.uint8),
        np.zeros(PITCH, np.uint8),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def find_centres(
    pixels: NDArray[np.uint8], blocks: Blocks, chosen: NDArray[np.int64], wanted: Wanted
) -> NDArray[Any]:
    """The centres wanted.

    Parameters
    ----------
    pixels : (H W + 64,) uint8
        The image in scan order, and zeros: a zero adds nothing to any sum.
    blocks : Blocks
    chosen : (N,) int64
        Indices of the blocks to evaluate.
    wanted : Wanted

    Returns
    -------
    (M,) CENTRE
        In the order of the blocks.
    """
    samples = blocks.samples
    memory = memory_for(samples)
    eights = memory.matters.view(np.uint64)
    votes = blocks.votes.reshape(-1)
    of_outer = blocks.votes.shape[1]
    found = np.empty(_ROOM, CENTRE)
    count = 0
    half = len(memory.gathered) // 2
    if len(chosen) > 0:
        b = chosen[0]
        copies = blocks.bounds[b + 1] - blocks.bounds[b]
        gather(
            pixels, blocks.copies, memory.gathered, np.int64(blocks.stride[b]), blocks.bounds[b],
            copies, np.int64(0),
        )  # fmt: skip
    for n in range(len(chosen)):
        b = chosen[n]
        place = blocks.place[b]
        width = blocks.place[b + 1] - place
        stride = blocks.stride[b]
        # There are two places for grey values, used alternately.
        here = (n % 2) * half
        following = int(chosen[n + 1]) if n + 1 < len(chosen) else -1
        sum_and_gather(memory, here, samples, width, pixels, blocks, following, half - here)
        if blocks.whole[b]:
            compare_whole(memory, samples, width, wanted)
        else:
            compare(memory, votes, place, width, wanted)
        if wanted.votes > 0:
            for i in range(width):
                total = votes[place + i] + votes[place + of_outer + i]
                memory.lacking[i] = total < 2 * samples
            vote(memory, here, samples, width, wanted)
        if count + width > len(found):
            more = np.empty(2 * len(found), CENTRE)
            more[:count] = found[:count]
            found = more
        for k in range(width // 8):
            if eights[k] == 0:
                continue
            for i in range(8 * k, 8 * k + 8):
                if memory.matters[i] and _judge(
                    memory, i, votes[place + i], votes[place + of_outer + i], samples, wanted,
                    found[count],
                ):  # fmt: skip
                    found[count].u = blocks.column[b] + stride * i
                    found[count].v = blocks.row[b]
                    count += 1
    return found[:count]


_kept = threading.local()


def with_zeros(image: NDArray[np.uint8], table: DiscTable) -> NDArray[np.uint8]:
    """The image's pixels, with the zeros that the table wants behind them.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    table : DiscTable

    Returns
    -------
    (H W + 64,) uint8
        In scan order; only those pixels from the first on that the table refers to. It is the
        calling thread's, until it asks again: memory that is new for every image has to be fetched.

    Raises
    ------
    FrameError
        If the image does not belong to the table.
    """
    expected = table.floor_xy.shape[:2]
    if image.shape != expected or image.dtype != np.uint8:
        raise FrameError(
            f"the image is {image.dtype} of shape {image.shape}: the table is for uint8 of shape "
            f"{expected}"
        )
    pixels: NDArray[np.uint8] | None = getattr(_kept, "pixels", None)
    if pixels is None or len(pixels) != image.size + COPIED:
        pixels = _kept.pixels = np.zeros(image.size + COPIED, np.uint8)
    first = table.first_source
    pixels[first : image.size] = image.reshape(-1)[first:]
    return pixels


def blocks_of(table: DiscTable) -> Blocks:
    """The table as compiled loops take it."""
    return Blocks(
        table.samples, table.copies, table.block_copies, table.block_row, table.block_column,
        table.block_stride, table.block_whole, table.block_votes, table.votes,
    )  # fmt: skip


def quality_of_centres(
    image: NDArray[np.uint8], table: DiscTable
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
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
    every = np.arange(len(table.block_row))
    found = find_centres(
        with_zeros(image, table), blocks_of(table), every, Wanted(0.0, 0.0, 0.0, 0, 0)
    )
    quality, contrast = np.zeros(image.shape), np.zeros(image.shape, np.float32)
    quality[found["v"], found["u"]] = found["quality"]
    contrast[found["v"], found["u"]] = found["contrast"]
    return quality, contrast
