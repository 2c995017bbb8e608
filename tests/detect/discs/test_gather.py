"""Which pixels a disc is fitted to, held against their definition."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from camera import Camera
from detect.circles import vote_shape
from detect.discs.fit import fit_settings
from detect.discs.model import GREY, ONE, PLANE_X, PLANE_Y, Disc
from detect.discs.patch import EDGE, PATCH, WHOLE, Candidate, FitSettings, Gathered, gather, padded
from detect.settings import CircleSettings
from lut import VoteTable, build_vote_table
from tests.reference.discs import pixels_within_reach

RADIUS = 0.1
NOMINAL = Disc(0.0, 0.0, 1.0, 0.0)


@pytest.fixture(scope="module")
def table(published_camera: Camera) -> VoteTable:
    return build_vote_table(published_camera, vote_shape(CircleSettings()))


@njit(error_model="numpy")
def _gather(
    image: NDArray[np.uint8], floor_xy: NDArray[np.float32], candidate: Candidate,
    settings: FitSettings, start: Disc, patch: Any,
) -> Gathered:  # fmt: skip
    return gather(image, floor_xy, candidate, settings, start, patch[0])


def gathered(
    table: VoteTable,
    image: NDArray[np.uint8],
    candidate: Candidate,
    start: Disc = NOMINAL,
) -> tuple[Gathered, dict[str, Any]]:
    """`gather` into a patch that was used before."""
    patch = np.zeros(1, PATCH)
    for name in ("x", "y", "design", "weight", "row"):
        patch[name] = 7.0
    settings = fit_settings(1.0, 0.5)
    found = _gather(image, table.floor_xy, candidate, settings, start, patch)
    return found, {name: patch[name][0] for name in PATCH.names or ()}


@pytest.mark.parametrize(("u", "v"), [(400, 160), (200, 130), (500, 110), (3, 150), (765, 165)])
def test_patches_are_the_pixels_within_reach(table: VoteTable, u: int, v: int) -> None:
    image = np.random.default_rng(3).integers(0, 256, table.floor_xy.shape[:2], np.uint8)
    candidate = Candidate(u, v, RADIUS, 0.8)
    found, patch = gathered(table, image, candidate)
    n = found.fitted
    index = patch["pixel"][:n].astype(int)
    assert np.all(np.diff(index) > 0)
    expected = pixels_within_reach(table.floor_xy, candidate, fit_settings(1.0, 0.5))
    # Single and double precision may differ about a pixel on the limit.
    assert len(set(expected) ^ set(index)) <= 2
    floor = table.floor_xy.astype(float)
    rows, columns = np.divmod(index, image.shape[1])
    place = (floor[rows, columns] - floor[v, u]) / RADIUS
    design = patch["design"]
    np.testing.assert_allclose(design[[PLANE_X, PLANE_Y], :n].T, place, atol=2e-5)
    np.testing.assert_array_equal(design[GREY, :n], image[rows, columns].astype(int) - image[v, u])
    np.testing.assert_array_equal(design[ONE, :n], 1.0)
    # What fills up the patch is nowhere.
    assert n <= found.n == padded(n) < n + WHOLE
    assert found.n % WHOLE == 0
    np.testing.assert_array_equal(design[[*range(5), GREY], n : found.n], 0.0)
    np.testing.assert_array_equal(patch["weight"][n : found.n], 0.0)
    assert np.all(patch["x"][n : found.n] > 100.0)


def test_patches_lie_about_the_start_of_the_fit(table: VoteTable) -> None:
    image = np.zeros(table.floor_xy.shape[:2], np.uint8)
    start = Disc(0.1, -0.2, 1.2, 0.0)
    found, patch = gathered(table, image, Candidate(400, 200, RADIUS, 0.8), start=start)
    place = table.floor_xy.reshape(-1, 2)[patch["pixel"][: found.fitted].astype(int)]
    off = place - table.floor_xy[200, 400] - RADIUS * np.array([start.x, start.y])
    r = np.linalg.norm(off, axis=-1) / (RADIUS * start.radius)
    at_edge = patch["weight"][: found.fitted] == 1
    assert r[at_edge].max() < 1.5
    assert r.max() == pytest.approx(1.7, abs=0.05)


@pytest.mark.parametrize("v", [200, 115])
def test_steps_are_those_of_the_floor(table: VoteTable, v: int) -> None:
    """The steeper axis comes first where the disc is seen flat."""
    image = np.zeros(table.floor_xy.shape[:2], np.uint8)
    found, patch = gathered(table, image, Candidate(400, v, RADIUS, 0.8))
    rows, columns = np.divmod(patch["pixel"][: found.fitted].astype(int), table.floor_xy.shape[1])
    floor = table.floor_xy.astype(float)
    by_u = (floor[rows, columns + 1] - floor[rows, columns - 1]) / (2.0 * RADIUS)
    by_v = (floor[rows + 1, columns] - floor[rows - 1, columns]) / (2.0 * RADIUS)
    assert (found.shape == EDGE) == (v == 200)
    first, second = (by_u, by_v) if found.shape == EDGE else (by_v, by_u)
    for axis, steps in ((1, first), (2, second)):
        for k, name in enumerate("xy"):
            told = patch[f"{name}{axis}"][: found.fitted]
            np.testing.assert_allclose(told, steps[:, k], atol=1e-5)
    if found.shape != EDGE:
        lengths = np.linalg.norm(np.diff(floor[v - 1 : v + 2, 400], axis=0), axis=-1)
        expected = 2.0 * (lengths[1] - lengths[0]) / lengths.sum()
        assert patch["growth"] == pytest.approx(expected, abs=1e-4)


def test_of_large_discs_all_of_the_edge_is_taken_and_some_of_the_rest(table: VoteTable) -> None:
    image = np.zeros(table.floor_xy.shape[:2], np.uint8)
    candidate = Candidate(400, 250, RADIUS, 0.8)
    found, patch = gathered(table, image, candidate)
    index = patch["pixel"][: found.fitted].astype(int)
    weight = patch["weight"][: found.fitted]
    every = set(pixels_within_reach(table.floor_xy, candidate, fit_settings(1.0, 0.5)))
    assert len(set(index)) == found.fitted < 0.7 * len(every)
    assert len(set(index) - every) <= 2
    off = np.linalg.norm(table.floor_xy.reshape(-1, 2)[index] - table.floor_xy[250, 400], axis=-1)
    at_edge = weight == 1
    assert np.all(np.abs(off[at_edge] / RADIUS - 1.0) < 0.3)
    # The others stand for several pixels each, those far from the disc for none.
    often = int(weight.max())
    assert set(weight[~at_edge]) == {0, often}
    assert (~at_edge).sum() == pytest.approx((len(every) - at_edge.sum()) / often, rel=0.1)
