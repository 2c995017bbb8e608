"""Compiled loops of the disc detector: the quality of every centre; no two discs in one place.

quality = between-class variance / total variance of the grey values that vote. With n = n_inner +
n_outer votes,

    difference = n_outer sum(inner) - n_inner sum(outer)
    spread     = n sum(x^2) - (sum x)^2
    quality    = difference^2 / (n_inner n_outer spread)

All of these are whole numbers, so the only rounding is that of the one final division.

Numba's cache notices a change of this file, but not one of `detect.discs.vector_kernels`, which is
compiled into these: whoever changes that one has to touch this file as well.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.patch import padded
from detect.discs.vector_kernels import (
    gather,
    lowest_bit,
    promising,
    promising_all_vote,
    sum_and_gather,
    vote,
)
from lut.kernels import BLOCK, GROUP, LEAST_COPIES

_ONE = np.uint64(1)
_TWO = np.uint64(2)

#: The first comparison of a quality with the threshold lets through a little more than the second:
#: its numbers have 24 bits.
_FIRST_COMPARISON = 1.0 - 4e-6


@njit(cache=True, error_model="numpy", forceinline=True)
def _sum_block(
    pixels: NDArray[np.uint8],
    samples: int,
    copies: NDArray[np.uint32],
    block_copies: NDArray[np.int64],
    gathered: NDArray[np.uint8],
    sums: NDArray[np.uint16],
    products: NDArray[np.uint32],
    block: int,
    fresh: bool,
) -> None:
    """Sums of a block, which is already gathered unless `fresh`, and gather the next.

    There are two places for grey values, used alternately: what was just written cannot be read at
    once.
    """
    groups = -(-samples // GROUP)
    size = len(gathered) // 2
    here = (block & 1) * size
    if fresh:
        gather(pixels, copies, block_copies[block], block_copies[block + 1], gathered, here)
    # Behind the last block that one comes again.
    following = min(block + 1, len(block_copies) - 2)
    first = block_copies[following]
    place = sum_and_gather(
        pixels, copies, first, gathered, size - here, here, groups, sums, products
    )
    rest = first + groups * LEAST_COPIES
    gather(pixels, copies, rest, block_copies[following + 1], gathered, place)


@njit(cache=True, error_model="numpy", nogil=True)
def _quality(
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


def working_memory(
    samples: int,
) -> tuple[NDArray[np.uint8], NDArray[np.uint16], NDArray[np.uint32]]:
    """Memory for the grey values of two blocks, and for the sums of one."""
    size = 2 * (2 * -(-samples // GROUP) * GROUP * BLOCK + BLOCK)
    # It begins where a cache line does: half of all copies then stay within one.
    memory = np.empty(size + BLOCK, np.uint8)
    begin = -memory.ctypes.data % BLOCK
    return (
        memory[begin : begin + size],
        np.empty((2, BLOCK), np.uint16),
        np.empty((2, BLOCK // 2), np.uint32),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def quality_map(
    pixels: NDArray[np.uint8],
    samples: int,
    copies: NDArray[np.uint32],
    block_copies: NDArray[np.int64],
    block_row: NDArray[np.int32],
    block_column: NDArray[np.int32],
    block_pattern: NDArray[np.int32],
    patterns: NDArray[np.uint8],
    gathered: NDArray[np.uint8],
    sums: NDArray[np.uint16],
    products: NDArray[np.uint32],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
) -> None:
    """Otsu's quality of the two outlines' grey values around every usable centre.

    Parameters
    ----------
    pixels : (H W + 64,) uint8
        The image in scan order, and zeros: a zero adds nothing to any sum.
    samples, copies, block_copies, block_row, block_column, block_pattern, patterns
        The table (see `lut.DiscTable`).
    gathered, sums, products
        Memory to work in (`working_memory`).
    quality : (H, W) float64
        Result, in [0, 1]; 0 where all grey values are equal. Nothing is written where there is no
        block.
    contrast : (H, W) float32
        Result: mean grey value inside minus outside.
    """
    in_order = np.empty(BLOCK, np.uint32)
    for b in range(len(block_row)):
        _sum_block(pixels, samples, copies, block_copies, gathered, sums, products, b, b == 0)
        for i in range(np.uint64(BLOCK // 2)):
            in_order[_TWO * i] = products[0, i]
            in_order[_TWO * i + _ONE] = products[1, i]
        v = np.uint64(block_row[b])
        u = np.uint64(block_column[b])
        pattern = np.uint64(block_pattern[b])
        # Unsigned indices and no branch: several centres at once.
        for i in range(min(np.uint64(BLOCK), np.uint64(quality.shape[1]) - u)):
            quality[v, u + i], contrast[v, u + i] = _quality(
                np.float64(sums[0, i]),
                np.float64(sums[1, i]),
                np.float64(in_order[i]),
                np.float64(patterns[pattern, 0, i]),
                np.float64(patterns[pattern, 1, i]),
            )


@njit(cache=True, error_model="numpy", forceinline=True)
def _vote_block(
    gathered: NDArray[np.uint8],
    samples: int,
    block: int,
    some_outside: bool,
    sign: float,
    step: int,
    least_votes: int,
    votes: NDArray[np.uint8],
) -> tuple[np.uint64, np.uint64]:
    """Which centres of the block whose sums were taken last have votes enough: light, dark ones."""
    groups = np.uint64(-(-samples // GROUP))
    inner = np.uint64((block & 1) * (len(gathered) // 2))
    outer = inner + groups * np.uint64(GROUP * BLOCK)
    light = dark = np.uint64(0)
    if sign >= 0.0:
        light = vote(
            gathered,
            inner,
            outer,
            groups,
            step,
            1 if some_outside else 0,
            least_votes,
            votes,
            np.uint64(0),
        )
    if sign <= 0.0:
        dark = vote(gathered, outer, inner, groups, step, 0, least_votes, votes, np.uint64(BLOCK))
    return light, dark


@njit(cache=True, error_model="numpy", nogil=True)
def centres_above(
    pixels: NDArray[np.uint8],
    samples: int,
    copies: NDArray[np.uint32],
    block_copies: NDArray[np.int64],
    block_row: NDArray[np.int32],
    block_column: NDArray[np.int32],
    block_pattern: NDArray[np.int32],
    patterns: NDArray[np.uint8],
    threshold: float,
    sign: float,
    step: int,
    least_votes: int,
    votes: NDArray[np.uint8],
    gathered: NDArray[np.uint8],
    sums: NDArray[np.uint16],
    products: NDArray[np.uint32],
    block: int,
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    score: NDArray[np.float64],
) -> tuple[int, int]:
    """Centres whose quality reaches a threshold: those of `quality_map`, without the map.

    And, if so asked, those round which the grey value steps in most directions: something bright or
    dark beside a disc raises the total variance, and so ruins the quality, but not the steps.

    It goes on from one block until the image or the space for results ends. Nothing is allocated
    here: counting references would cost as much as all the rest.

    Parameters
    ----------
    pixels, samples, copies, block_copies, block_row, block_column, block_pattern, patterns
        As in `quality_map`.
    threshold : float
        Least quality, above 0.
    sign : float
        1 for centres lighter than what is around them, -1 for darker ones, 0 for both.
    step : int
        Pairs of samples in the same direction vote if they differ by more than this, grey levels.
    least_votes : int
        Centres with at least this number of votes of the sign are results, too; 0: the quality
        alone decides.
    votes : (2 * BLOCK,) uint8
        Memory to work in.
    gathered, sums, products
        Memory to work in (`working_memory`).
    block : int
        First block to look at.
    columns, rows : (M,) int64, M >= 64
    quality : (M,) float64
    contrast : (M,) float32
    score : (M,) float64
        Results, in scan order. The score is the quality where that reaches the threshold; else it
        is the share of the votes, scaled to stay below the threshold, and the contrast has their
        sign.

    Returns
    -------
    block, count : int
        The first block that was not evaluated, and the number of results.
    """
    count = 0
    share = np.float32(threshold * _FIRST_COMPARISON)
    per_vote = threshold / (samples + 1.0)
    blocks = len(block_row)
    for b in range(block, blocks):
        if count + BLOCK > len(columns):
            return b, count
        fresh = b == block
        _sum_block(pixels, samples, copies, block_copies, gathered, sums, products, b, fresh)
        pattern = block_pattern[b]
        if pattern == 0:
            mask = promising_all_vote(sums, products, samples, share)
        else:
            mask = promising(sums, products, patterns, pattern, share)
        light, dark = np.uint64(0), np.uint64(0)
        if least_votes > 0:
            light, dark = _vote_block(
                gathered, samples, b, pattern != 0, sign, step, least_votes, votes
            )
            mask |= light | dark
        while mask != 0:
            i = lowest_bit(mask)
            mask &= mask - _ONE
            here, difference = _quality(
                np.float64(sums[0, i]),
                np.float64(sums[1, i]),
                np.float64(products[i & _ONE, i >> _ONE]),
                np.float64(patterns[pattern, 0, i]),
                np.float64(patterns[pattern, 1, i]),
            )
            clear = here >= threshold and here > 0.0 and difference * sign >= 0.0
            by_light = (light >> i) & _ONE
            voted = (by_light | ((dark >> i) & _ONE)) != 0 and patterns[pattern, 0, i] > 0
            if clear or voted:
                columns[count] = block_column[b] + np.int64(i)
                rows[count] = block_row[b]
                quality[count] = here
                if clear:
                    contrast[count] = difference
                    score[count] = here
                else:
                    least = step + 1.0
                    contrast[count] = (
                        max(difference, least) if by_light else min(difference, -least)
                    )
                    score[count] = per_vote * votes[(_ONE - by_light) * np.uint64(BLOCK) + i]
                count += 1
    return blocks, count


@njit(cache=True, error_model="numpy")
def suppress_neighbours(
    floor_xy: NDArray[np.float64], score: NDArray[np.float64], separation: float
) -> NDArray[np.bool_]:
    """Which of some floor positions to keep so that no two are closer than `separation`.

    The best by score stay; of equal ones the first.

    Parameters
    ----------
    floor_xy : (N, 2) float64
        Positions, metres.
    score : (N,) float64
    separation : float
        Metres.

    Returns
    -------
    (N,) bool
    """
    order = np.argsort(-score, kind="mergesort")
    kept = np.zeros(len(score), np.bool_)
    # Those chosen; what fills up is near to nothing.
    x = np.full(padded(len(score)), np.inf)
    y = np.full(padded(len(score)), np.inf)
    count = 0
    for i in order:
        x0, y0 = floor_xy[i, 0], floor_xy[i, 1]
        if not _near_any(x, y, padded(count), x0, y0, separation * separation):
            kept[i] = True
            x[count], y[count] = x0, y0
            count += 1
    return kept


@njit(cache=True, error_model="numpy", nogil=True)
def _near_any(
    x: NDArray[np.float64], y: NDArray[np.float64], count: int, x0: float, y0: float, near: float
) -> bool:
    """Whether a place is nearer than the root of `near` to one of the first `count`."""
    found = 0
    # All alike, without branches: so several are worked on at a time.
    for k in range(count):
        dx = x[k] - x0
        dy = y[k] - y0
        found |= 1 if dx * dx + dy * dy < near else 0
    return found != 0
