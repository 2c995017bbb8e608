"""Local maxima, and the best within a distance, against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from detect.discs import candidates
from tests.reference.centres import plain_maxima


def local_maxima(
    quality: NDArray[np.float64], threshold: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    rows, columns = np.nonzero(candidates.local_maxima(quality, threshold))
    return columns, rows


MAPS = hnp.arrays(
    np.int8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.integers(0, 3)
)


def test_nan_is_no_maximum_and_hides_none() -> None:
    quality = np.full((3, 3), np.nan)
    quality[1, 1] = 0.7
    columns, rows = local_maxima(quality, 0.6)
    assert (columns.tolist(), rows.tolist()) == ([1], [1])


def test_an_image_that_is_one_plateau_has_one_maximum_in_its_middle() -> None:
    columns, rows = local_maxima(np.ones((288, 767)), 0.6)
    assert len(columns) == 1
    assert columns[0] == 383
    assert rows[0] in (143, 144)


def assert_maxima(quality: NDArray[np.float64], threshold: float) -> int:
    """Each plateau is found once, at one of the pixels nearest to its middle; gives how many."""
    columns, rows = local_maxima(quality, threshold)
    found, expected = set(zip(columns.tolist(), rows.tolist())), plain_maxima(quality, threshold)
    assert [len(found.intersection(nearest)) for nearest in expected] == [1] * len(found)
    return len(found)


@settings(max_examples=300)
@given(MAPS, st.sampled_from([0.0, 0.25, 0.5, 0.75]))
def test_every_plateau_is_found_once_at_its_middle(
    levels: NDArray[np.int8], threshold: float
) -> None:
    assert_maxima(levels / 4.0, threshold)


@pytest.mark.parametrize("levels", [1, 2, 30])
def test_large_plateaus_and_many_of_them(levels: int) -> None:
    rng = np.random.default_rng(levels)
    few = rng.integers(1, levels + 1, (12, 20)) * rng.integers(0, 2, (12, 20))
    assert assert_maxima(np.asarray(np.kron(few / 30.0, np.ones((5, 7))), np.float64), 0.01) > 1


def plain_suppression(
    floor_xy: NDArray[np.float64], score: NDArray[np.float64], separation: float
) -> NDArray[np.bool_]:
    """From the best to the worst, the first of equal ones first."""
    kept = np.zeros(len(score), bool)
    for i in sorted(range(len(score)), key=lambda i: (-score[i], i)):
        gap = floor_xy[kept] - floor_xy[i]
        kept[i] = not np.any((gap * gap).sum(axis=1) < separation * separation)
    return kept


# A lattice of eighths: distances and their comparison with the separation are exact.
POSITIONS = hnp.arrays(
    np.int8, st.tuples(st.integers(0, 40), st.just(2)), elements=st.integers(0, 24)
)


@settings(max_examples=300)
@given(POSITIONS, st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_the_best_stay_and_no_two_are_too_close(
    lattice: NDArray[np.int8], eighths: int, seed: int
) -> None:
    floor_xy, separation = lattice / 8.0, eighths / 8.0
    score = np.random.default_rng(seed).integers(-3, 4, len(lattice)) / 2.0
    kept = np.zeros(len(score), np.bool_)
    kept[candidates.suppress_close(floor_xy, np.argsort(-score, kind="stable"), separation)] = True
    np.testing.assert_array_equal(kept, plain_suppression(floor_xy, score, separation))
