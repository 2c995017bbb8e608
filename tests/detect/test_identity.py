"""IDs carried over: what was shuffled and moved comes back to its own disc, or to none."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.identity import ids_of_rows
from redetect.landmarks import CircleLandmark

#: Two standard deviations of which 99.9 % of two-dimensional errors are nearer.
GATE = math.sqrt(2.0 * math.log(1000.0))


def row(x: float, y: float, *ids: int) -> CircleLandmark:
    return CircleLandmark(x, y, 0.9, 1e-4, 0.0, 1e-4, ids)


@given(seed=st.integers(0, 2**31), count=st.integers(1, 12), dropped=st.integers(0, 4))
def test_shuffled_discs_keep_their_ids(seed: int, count: int, dropped: int) -> None:
    rng = np.random.default_rng(seed)
    grid = np.stack(np.divmod(rng.permutation(36)[:count], 6), axis=-1) * 0.25
    order = rng.permutation(count)[: max(count - dropped, 1)]
    seen = grid[order] + rng.uniform(-0.01, 0.01, (len(order), 2))

    ids = ids_of_rows(seen, [row(x, y, 7 * k) for k, (x, y) in enumerate(grid.tolist())])

    assert ids == [(7 * int(k),) for k in order]


@given(seed=st.integers(0, 2**31))
def test_one_disc_gives_its_id_to_one_within_the_gate(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy, known = rng.uniform(0.0, 0.1, (8, 2)), rng.uniform(0.0, 0.1, (6, 2))

    ids = ids_of_rows(xy, [row(x, y, k) for k, (x, y) in enumerate(known.tolist())])

    given_to = {own[0]: n for n, own in enumerate(ids) if own}
    assert len(given_to) == sum(map(bool, ids))
    near = np.linalg.norm(xy[:, None] - known, axis=-1) < 0.01 * GATE
    assert all(near[n, k] for k, n in given_to.items())
    # No two that are left over are within the gate.
    alone = [n for n in range(8) if not ids[n]], [k for k in range(6) if k not in given_to]
    assert not near[np.ix_(*alone)].any()


@pytest.mark.parametrize(("off", "expected"), [(GATE - 0.01, (5,)), (GATE + 0.01, ())])
def test_the_gate_counts_all_that_is_stated(off: float, expected: tuple[int, ...]) -> None:
    """Row, map and slack: 3 and 4 cm, and 12 cm, are 13 cm together."""
    disc = CircleLandmark(0.0, -2.0, 0.0, 0.04**2, 0.0, 0.04**2, (5,))
    floor_xy = np.array([[0.13 * off, -2.0]])

    ids = ids_of_rows(floor_xy, [disc], np.array([0.03**2 * np.eye(2)]), 0.12)

    assert ids == [expected]


def test_a_row_without_a_usable_covariance_matches_nothing() -> None:
    disc = CircleLandmark(0.0, -2.0, 0.0, 1.0, 2.0, 1.0, (5,))
    assert ids_of_rows(np.array([[0.01, -2.01]]), [disc]) == [()]


def test_nothing_is_known_of_nothing() -> None:
    one = np.array([[0.0, -2.0]])
    assert ids_of_rows(one, []) == [()]
    assert ids_of_rows(one[:0], [row(0.0, -2.0, 1)]) == []
    assert ids_of_rows(one, [], np.eye(2)[None], 0.1) == [()]


def test_a_row_of_several_ids_keeps_them() -> None:
    assert ids_of_rows(np.array([[0.0, -2.0]]), [row(0.0, -2.0, 3, 9)]) == [(3, 9)]


def test_rows_with_a_singular_covariance_give_no_id() -> None:
    nothing = CircleLandmark(0.0, -1.0, 0.9, 0.0, 0.0, 0.0, (1,))
    flat = CircleLandmark(0.5, -1.0, 0.9, 1e-4, 1e-4, 1e-4, (2,))
    xy = np.array([[0.0, -1.0], [0.5, -1.0], [-0.5, -1.0]])
    known = [nothing, flat, row(-0.5, -1.0, 3)]
    assert ids_of_rows(xy, known) == [(), (), (3,)]
    # With errors of their own, the discs determine the distance.
    own = np.tile(1e-4 * np.eye(2), (3, 1, 1))
    assert ids_of_rows(xy, known, own) == [(1,), (2,), (3,)]
