"""IDs carried over: what was shuffled and moved comes back to its own disc, or to none."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.discs.identity import ids_of_rows, matched
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
def test_one_disc_gives_its_id_to_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy, known = rng.uniform(0.0, 0.3, (8, 2)), rng.uniform(0.0, 0.3, (6, 2))
    spread = np.tile(0.05**2 * np.eye(2), (8, 1, 1))

    found = matched(xy, spread, known, spread[:6])

    own = found[found >= 0]
    assert len(set(own.tolist())) == len(own)
    # No two that are left over are within the gate, and no pair would rather have each other.
    distance = np.linalg.norm(xy[:, None] - known, axis=-1) / (0.05 * math.sqrt(2.0))
    partner = np.full(6, -1)
    partner[own] = np.flatnonzero(found >= 0)
    for n in range(8):
        for m in range(6):
            if distance[n, m] < GATE:
                mine = distance[n, found[n]] if found[n] >= 0 else GATE
                theirs = distance[partner[m], m] if partner[m] >= 0 else GATE
                assert distance[n, m] >= min(mine, theirs)


@pytest.mark.parametrize(("off", "expected"), [(GATE - 0.01, (5,)), (GATE + 0.01, ())])
def test_the_gate_counts_all_that_is_stated(off: float, expected: tuple[int, ...]) -> None:
    """Row, map and slack: 3 and 4 cm, and 12 cm, are 13 cm together."""
    disc = CircleLandmark(0.0, -2.0, 0.0, 0.04**2, 0.0, 0.04**2, (5,))
    floor_xy = np.array([[0.13 * off, -2.0]])

    ids = ids_of_rows(floor_xy, [disc], np.array([0.03**2 * np.eye(2)]), 0.12)

    assert ids == [expected]


def test_nothing_is_known_of_nothing() -> None:
    one = np.array([[0.0, -2.0]])
    assert ids_of_rows(one, []) == [()]
    assert ids_of_rows(one[:0], [row(0.0, -2.0, 1)]) == []
    assert ids_of_rows(one, [], np.eye(2)[None], 0.1) == [()]


def test_a_row_of_several_ids_keeps_them() -> None:
    assert ids_of_rows(np.array([[0.0, -2.0]]), [row(0.0, -2.0, 3, 9)]) == [(3, 9)]
