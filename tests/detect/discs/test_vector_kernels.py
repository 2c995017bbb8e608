"""The operations on vectors of pixels against plain arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from detect.discs.vector_kernels import (
    gather,
    lowest_bit,
    promising,
    promising_all_vote,
    sum_and_gather,
    vote,
)
from lut.kernels import ADVANCE_BITS, BLOCK, GROUP, LEAST_COPIES

Bytes = NDArray[np.uint8]
Sums = NDArray[np.uint16]
Products = NDArray[np.uint32]


@njit(error_model="numpy")
def _gather(
    pixels: Bytes, copies: NDArray[np.uint32], first: int, end: int, gathered: Bytes, to: int
) -> None:
    gather(pixels, copies, first, end, gathered, to)


@njit(error_model="numpy")
def _sum_and_gather(
    pixels: Bytes,
    copies: NDArray[np.uint32],
    first: int,
    gathered: Bytes,
    to: int,
    read: int,
    groups: int,
    sums: Sums,
    products: Products,
) -> int:
    place: int = sum_and_gather(pixels, copies, first, gathered, to, read, groups, sums, products)
    return place


@njit(error_model="numpy")
def _promising_all_vote(sums: Sums, products: Products, samples: int, share: float) -> int:
    mask: int = promising_all_vote(sums, products, samples, np.float32(share))
    return mask


@njit(error_model="numpy")
def _promising(sums: Sums, products: Products, patterns: Bytes, pattern: int, share: float) -> int:
    mask: int = promising(sums, products, patterns, pattern, np.float32(share))
    return mask


@njit(error_model="numpy")
def _lowest_bit(mask: np.uint64) -> int:
    bit: int = lowest_bit(mask)
    return bit


def random_copies(
    rng: np.random.Generator, pixels: int, count: int
) -> tuple[NDArray[np.uint32], NDArray[np.int64], NDArray[np.int64]]:
    source = rng.integers(0, pixels - BLOCK + 1, count)
    advance = rng.integers(0, BLOCK + 1, count)
    return ((source << ADVANCE_BITS) | advance).astype(np.uint32), source, advance


def carried_out(
    pixels: Bytes, source: NDArray[np.int64], advance: NDArray[np.int64], gathered: Bytes, to: int
) -> int:
    for s, a in zip(source.tolist(), advance.tolist()):
        gathered[to : to + BLOCK] = pixels[s : s + BLOCK]
        to += a
    return to


def sums_of(gathered: Bytes, samples: int) -> tuple[Sums, Products]:
    """In the form of the operations; `gathered` is (2 samples, BLOCK)."""
    x = gathered.astype(np.int64).reshape(2, samples, BLOCK)
    product = (x * (255 - x)).sum(axis=(0, 1))
    products = np.stack([product[0::2], product[1::2]])
    return x.sum(axis=1).astype(np.uint16), products.astype(np.uint32)


@pytest.mark.parametrize("bits", [32, 64])
def test_copies_are_carried_out_one_after_the_other(bits: int) -> None:
    rng = np.random.default_rng(bits)
    pixels = rng.integers(0, 256, 1000, dtype=np.uint8)
    copies, source, advance = random_copies(rng, 1000, 40)
    expected = np.full(4000, 7, np.uint8)
    gathered = expected.copy()
    carried_out(pixels, source[4:32], advance[4:32], expected, 13)
    _gather(pixels, copies.astype(f"uint{bits}"), 4, 32, gathered, 13)
    assert np.array_equal(gathered, expected)
    _gather(pixels, copies, 8, 8, gathered, 0)
    assert np.array_equal(gathered, expected)


@pytest.mark.parametrize("groups", [1, 2, 4, 32])
@pytest.mark.parametrize("grey", ["random", "black", "white", "middle"])
def test_sums_of_one_block_and_copies_for_another(groups: int, grey: str) -> None:
    rng = np.random.default_rng(groups)
    rows = 2 * groups * GROUP
    if grey == "random":
        block = rng.integers(0, 256, (rows, BLOCK), dtype=np.uint8)
    else:
        # The largest sums there are, and the largest products.
        block = np.full((rows, BLOCK), {"black": 0, "white": 255, "middle": 127}[grey], np.uint8)
    pixels = rng.integers(0, 256, 5000, dtype=np.uint8)
    count = LEAST_COPIES * groups
    copies, source, advance = random_copies(rng, 5000, count + 3)
    read, to = 5, rows * BLOCK + 11
    gathered = np.zeros(to + BLOCK * (count + 1), np.uint8)
    gathered[read : read + rows * BLOCK] = block.ravel()
    expected = gathered.copy()
    place = carried_out(pixels, source[3:], advance[3:], expected, to)

    sums, products = np.empty((2, BLOCK), np.uint16), np.empty((2, BLOCK // 2), np.uint32)
    assert place == _sum_and_gather(pixels, copies, 3, gathered, to, read, groups, sums, products)
    assert np.array_equal(gathered, expected)
    expected_sums, expected_products = sums_of(block, groups * GROUP)
    assert np.array_equal(sums, expected_sums)
    assert np.array_equal(products, expected_products)


def blocks(samples: int) -> list[Bytes]:
    """Grey values of blocks, of all degrees of contrast and noise."""
    rng = np.random.default_rng(samples)
    found = []
    for k in range(40):
        level = rng.integers(0, 256, (2, 1, BLOCK))
        x = level + rng.normal(0.0, [0.0, 0.7, 5.0, 30.0, 100.0][k % 5], (2, samples, BLOCK))
        found.append(np.clip(np.rint(x), 0, 255).astype(np.uint8).reshape(-1, BLOCK))
    found += [np.full((2 * samples, BLOCK), grey, np.uint8) for grey in (0, 255)]
    found.append(np.repeat(np.array([[255], [0]], np.uint8), samples, axis=0) * np.ones(
        BLOCK, np.uint8
    ))  # fmt: skip
    return found


def bits_of(mask: int) -> NDArray[np.bool_]:
    return np.array([mask >> i & 1 for i in range(BLOCK)], bool)


@pytest.mark.parametrize("samples", [3, 16, 128])
@pytest.mark.parametrize("threshold", [1e-6, 0.4, 0.6, 1.0])
def test_what_may_reach_a_threshold_where_all_vote(samples: int, threshold: float) -> None:
    reached = 0
    for block in blocks(samples):
        sums, products = sums_of(block, samples)
        mask = bits_of(_promising_all_vote(sums, products, samples, threshold * (1.0 - 4e-6)))
        x = block.astype(np.int64).reshape(2, samples, BLOCK)
        total = x.sum(axis=(0, 1))
        spread = 2 * samples * (x**2).sum(axis=(0, 1)) - total**2
        difference = x[0].sum(axis=0) - x[1].sum(axis=0)
        # Whatever reaches it is let through, and hardly anything that does not.
        assert np.all(mask[(difference**2 >= threshold * spread) & (spread > 0)])
        assert not np.any(mask[difference**2 < threshold * (1.0 - 1e-5) * spread])
        assert not np.any(mask[spread == 0])
        reached += int(np.count_nonzero(mask))
    assert 0 < reached < 43 * BLOCK


@pytest.mark.parametrize("samples", [3, 16, 128])
@pytest.mark.parametrize("threshold", [1e-6, 0.4, 0.6, 1.0])
def test_what_may_reach_a_threshold_where_some_do_not_vote(samples: int, threshold: float) -> None:
    rng = np.random.default_rng(samples)
    reached = 0
    for number, block in enumerate(blocks(samples)):
        patterns = rng.integers((samples + 1) // 2, samples + 1, (3, 2, BLOCK)).astype(np.uint8)
        patterns[:, :, rng.random(BLOCK) < 0.2] = 0
        votes = patterns[number % 3].astype(np.int64)
        # Samples without a vote are 0; centres without votes have anything at all.
        has_vote = np.arange(samples)[:, None] < votes[:, None]
        x = block.reshape(2, samples, BLOCK) * (has_vote | (votes[:, None] == 0))
        sums, products = sums_of(x.reshape(-1, BLOCK), samples)
        mask = bits_of(_promising(sums, products, patterns, number % 3, threshold * (1.0 - 4e-6)))
        x = x.astype(np.int64)
        n = votes.sum(axis=0)
        spread = n * (x**2).sum(axis=(0, 1)) - x.sum(axis=(0, 1)) ** 2
        difference = votes[1] * x[0].sum(axis=0) - votes[0] * x[1].sum(axis=0)
        bound = votes[0] * votes[1] * spread
        usable = n > 0
        assert np.all(mask[(difference**2 >= threshold * bound) & (spread > 0) & usable])
        assert not np.any(mask[(difference**2 < threshold * (1.0 - 1e-5) * bound) & usable])
        assert not np.any(mask[(spread == 0) | ~usable])
        reached += int(np.count_nonzero(mask))
    assert 0 < reached < 43 * BLOCK


def test_the_lowest_bit() -> None:
    for bit in range(64):
        assert _lowest_bit(np.uint64(1 << bit)) == bit
        assert _lowest_bit(np.uint64((1 << 63) | (1 << bit))) == bit


@njit(error_model="numpy")
def _vote(gathered: Bytes, groups: int, step: int, outside: int, least: int, votes: Bytes) -> int:
    mask: int = vote(
        gathered, np.uint64(0), np.uint64(groups * GROUP * BLOCK), np.uint64(groups),
        np.uint8(step), np.uint8(outside), np.uint8(least), votes, np.uint64(BLOCK),
    )  # fmt: skip
    return mask


@pytest.mark.parametrize("outside", [0, 1])
def test_votes_are_counted(outside: int) -> None:
    rng = np.random.default_rng(5)
    groups = 4
    grey = rng.integers(0, 256, (2, groups * GROUP, BLOCK)).astype(np.uint8)
    grey[1, rng.random(grey[1].shape) < 0.2] = 0
    votes = np.zeros(2 * BLOCK, np.uint8)
    mask = _vote(grey.ravel(), groups, 10, outside, 6, votes)
    inner, outer = grey.astype(int)
    difference = inner - outer + outside
    counts = outer > 0 if outside else np.ones(outer.shape, bool)
    expected = ((difference > 10) & counts).sum(axis=0)
    np.testing.assert_array_equal(votes[BLOCK:], expected)
    assert not votes[:BLOCK].any()
    bits = [bool(int(mask) >> i & 1) for i in range(BLOCK)]
    np.testing.assert_array_equal(bits, expected >= 6)
    assert 0 < sum(bits) < BLOCK
