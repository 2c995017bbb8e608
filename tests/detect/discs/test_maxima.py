"""Local maxima and plateaus against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import event, given, settings
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


def plateaus(quality: NDArray[np.float64], threshold: float) -> list[set[tuple[int, int]]]:
    """All 8-connected sets of equal quality that nothing next to them exceeds, as (v, u)."""
    height, width = quality.shape

    def around(v: int, u: int) -> set[tuple[int, int]]:
        return {
            (vn, un)
            for vn in range(v - 1, v + 2)
            for un in range(u - 1, u + 2)
            if (vn, un) != (v, u) and 0 <= vn < height and 0 <= un < width
        }

    left = {(int(v), int(u)) for v, u in np.argwhere((quality >= threshold) & (quality > 0.0))}
    found = []
    while left:
        start = left.pop()
        members, front = {start}, {start}
        while front:
            front = {
                p for at in front for p in around(*at) if quality[p] == quality[start]
            } - members
            members |= front
        left -= members
        if all(quality[p] <= quality[start] for at in members for p in around(*at)):
            found.append(members)
    return found


MAPS = hnp.arrays(
    np.int8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.integers(0, 3)
)


@settings(max_examples=300)
@given(MAPS, st.sampled_from([0.0, 0.25, 0.5, 0.75]))
def test_every_plateau_is_found_once_at_its_middle_in_scan_order(
    levels: NDArray[np.int8], threshold: float
) -> None:
    quality = levels / 4.0
    columns, rows = local_maxima(quality, threshold)
    found = list(zip(rows.tolist(), columns.tolist()))
    assert found == sorted(found)

    expected = plateaus(quality, threshold)
    event(f"maxima: {min(len(expected), 5)}, plateaus: {any(len(p) > 1 for p in expected)}")
    assert len(found) == len(expected)
    for members in expected:
        (representative,) = members & set(found)
        points = np.array(sorted(members), float)
        from_middle = np.linalg.norm(points - points.mean(axis=0), axis=1)
        own = np.linalg.norm(np.array(representative) - points.mean(axis=0))
        assert own <= from_middle.min() + 1e-9


def test_single_peaks_are_found_where_they_are() -> None:
    quality = np.zeros((5, 7))
    quality[0, 0], quality[4, 6], quality[2, 3], quality[2, 4] = 0.7, 0.61, 0.9, 0.8
    columns, rows = local_maxima(quality, 0.6)
    assert (columns.tolist(), rows.tolist()) == ([0, 3, 6], [0, 2, 4])


def test_the_threshold_itself_is_enough_and_zero_never_is() -> None:
    quality = np.zeros((3, 3))
    assert len(local_maxima(quality, 0.0)[0]) == 0
    quality[1, 1] = 0.6
    assert len(local_maxima(quality, 0.6)[0]) == 1
    assert len(local_maxima(quality, np.nextafter(0.6, 1.0))[0]) == 0


def test_a_plateau_with_a_higher_point_at_its_far_end_is_none() -> None:
    quality = np.full((1, 30), 0.7)
    quality[0, 29] = 0.8
    columns, _ = local_maxima(quality, 0.6)
    assert columns.tolist() == [29]
    quality[0, 29] = 0.7
    columns, _ = local_maxima(quality, 0.6)
    assert columns.tolist() in ([14], [15])


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


@settings(max_examples=300)
@given(MAPS, st.sampled_from([0.0, 0.25, 0.5, 0.75]))
def test_of_pixels_equally_near_to_the_middle_the_same_is_taken_every_time(
    levels: NDArray[np.int8], threshold: float
) -> None:
    quality = levels / 4.0
    columns, rows = local_maxima(quality, threshold)
    assert list(zip(columns.tolist(), rows.tolist())) == plain_maxima(quality, threshold)


@pytest.mark.parametrize("levels", [1, 2, 30])
def test_large_plateaus_and_many_of_them(levels: int) -> None:
    rng = np.random.default_rng(levels)
    few = rng.integers(1, levels + 1, (12, 20)) * rng.integers(0, 2, (12, 20))
    quality = np.asarray(np.kron(few / 30.0, np.ones((5, 7))), np.float64)
    found = np.array(local_maxima(quality, 0.01)).T
    assert len(found) > 1
    # Of the four pixels in the middle, rounding decides.
    for place in plain_maxima(quality, 0.01):
        assert np.abs(found - place).max(axis=1).min() <= 1
