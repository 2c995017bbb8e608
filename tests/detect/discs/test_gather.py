"""The pixels to which discs are fitted, against the plain reference."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from detect.discs import placing
from detect.discs.model import Disc
from detect.discs.patch import CAPACITY, EDGE, PATCH, SECTORS, Candidate, Reach, gather
from lut import VoteTable
from lut.outlines import floor_positions
from redetect.array_types import IntArray
from tests.reference.discs import pixels_within_reach

RADIUS, WHOLE = 0.1, placing.WHOLE.reach
NOMINAL = Disc(0.0, 0.0, 1.0)


def gathered(
    table: VoteTable, image: NDArray[np.uint8], candidate: Candidate, reach: Reach = WHOLE,
    start: Disc = NOMINAL,
) -> tuple[int, IntArray, NDArray[np.bool_], dict[str, Any]]:  # fmt: skip
    """Shape, ends, which pixels do not only fill up sectors, and a patch that was used before."""
    patch = np.zeros(1, PATCH)
    for name in ("x", "y", "shares", "weight", "row_x"):
        patch[name] = 7.0
    shape, ends = gather(image, table.floor_xy, candidate, 0.5, reach, start, patch[0])
    real = patch["weight"][0, : ends[SECTORS]] == 1.0
    return shape, ends, real, {name: patch[name][0] for name in PATCH.names or ()}


@pytest.mark.parametrize("reach", [WHOLE, placing.BY_PARTS.reach])
@pytest.mark.parametrize(("u", "v"), [(400, 160), (200, 130), (500, 110), (3, 150), (765, 165)])
def test_patches_are_the_pixels_within_reach(
    table: VoteTable, u: int, v: int, reach: Reach
) -> None:
    image = np.random.default_rng(3).integers(0, 256, table.floor_xy.shape[:2], np.uint8)
    candidate = Candidate(u, v, RADIUS, 0.8)
    _, ends, real, patch = gathered(table, image, candidate, reach)
    index = patch["pixel"][: ends[SECTORS]].astype(int)[real]
    assert len(set(index)) == len(index)
    expected = pixels_within_reach(table.floor_xy, candidate, reach, 0.5)
    # Single and double precision may differ about a pixel on the limit.
    assert len(set(expected) ^ set(index)) <= 2
    floor = table.floor_xy.astype(float)
    rows, columns = np.divmod(index, image.shape[1])
    place = (floor[rows, columns] - floor[v, u]) / RADIUS
    for k, name in enumerate("xy"):
        np.testing.assert_allclose(patch[name][: ends[SECTORS]][real], place[:, k], atol=2e-5)
    grey = image[rows, columns].astype(int) - image[v, u]
    np.testing.assert_array_equal(patch["grey"][: ends[SECTORS]][real], grey)


def test_sectors_are_those_of_the_angle(table: VoteTable) -> None:
    image = np.zeros(table.floor_xy.shape[:2], np.uint8)
    start = Disc(0.1, -0.2, 1.2)
    _, ends, real, patch = gathered(table, image, Candidate(400, 200, RADIUS, 0.8), start=start)
    assert np.all(ends % 8 == 0)
    assert ends[0] == 0
    x, y = (patch[name][: ends[SECTORS]] - at for name, at in (("x", start.x), ("y", start.y)))
    sector = np.repeat(np.arange(SECTORS), np.diff(ends))
    turned = np.arctan2(y, x) - 2.0 * np.pi * (sector + 0.5) / SECTORS
    off = np.abs(np.angle(np.exp(1j * turned)))[real]
    assert off.max() < np.pi / SECTORS + 1e-3
    r = np.hypot(x, y)[real] / start.radius
    assert r.max() == pytest.approx(WHOLE.radii, abs=0.05)


@pytest.mark.parametrize("v", [200, 115])
def test_steps_are_those_of_the_floor(table: VoteTable, v: int) -> None:
    """The steeper axis comes first where the disc is seen flat."""
    image = np.zeros(table.floor_xy.shape[:2], np.uint8)
    shape, ends, _, patch = gathered(table, image, Candidate(400, v, RADIUS, 0.8))
    index = patch["pixel"][: ends[SECTORS]].astype(int)
    rows, columns = np.divmod(index, table.floor_xy.shape[1])
    floor = table.floor_xy.astype(float)
    by_u = (floor[rows, columns + 1] - floor[rows, columns - 1]) / (2.0 * RADIUS)
    by_v = (floor[rows + 1, columns] - floor[rows - 1, columns]) / (2.0 * RADIUS)
    assert (shape == EDGE) == (v == 200)
    first, second = (by_u, by_v) if shape == EDGE else (by_v, by_u)
    for axis, steps in ((1, first), (2, second)):
        for k, name in enumerate("xy"):
            found = patch[f"{name}{axis}"][: ends[SECTORS]]
            np.testing.assert_allclose(found, steps[:, k], atol=1e-5)
    if shape != EDGE:
        lengths = np.linalg.norm(np.diff(floor[v - 1 : v + 2, 400], axis=0), axis=-1)
        expected = 2.0 * (lengths[1] - lengths[0]) / lengths.sum()
        assert patch["growth"] == pytest.approx(expected, abs=1e-4)


def test_of_large_discs_all_of_the_edge_is_taken_and_some_of_the_rest(table: VoteTable) -> None:
    image = np.zeros(table.floor_xy.shape[:2], np.uint8)
    candidate = Candidate(400, 250, RADIUS, 0.8)
    _, ends, real, patch = gathered(table, image, candidate)
    index = patch["pixel"][: ends[SECTORS]].astype(int)[real]
    every = set(pixels_within_reach(table.floor_xy, candidate, WHOLE, 0.5))
    assert len(set(index) - every) <= 2
    assert len(index) < 0.8 * len(every)

    def near_edge(pixels: list[int]) -> int:
        off = table.floor_xy.reshape(-1, 2)[pixels] - table.floor_xy[250, 400]
        return int(np.sum(np.abs(np.linalg.norm(off, axis=-1) / RADIUS - 1.0) < 0.03))

    assert near_edge(list(index)) == pytest.approx(near_edge(list(every)), abs=2)
    off = table.floor_xy.reshape(-1, 2)[list(every)] - table.floor_xy[250, 400]
    inner = np.linalg.norm(off, axis=-1) < 0.5 * RADIUS
    taken = np.isin(np.array(list(every))[inner], index)
    assert np.mean(taken) == pytest.approx(0.5, abs=0.2)


@pytest.mark.parametrize("half_px", [60, 150, 420, 900])
def test_of_still_larger_discs_rows_are_taken_from_all_of_it(
    table: VoteTable, half_px: int
) -> None:
    """Seen from above, so large that its edge alone has more pixels than are fitted."""
    side = 3 * half_px
    v, u = np.mgrid[:side, :side]
    floor_xy = np.stack([u, v], axis=-1).astype(np.float32) * np.float32(RADIUS / half_px)
    image = np.zeros((side, side), np.uint8)
    candidate = Candidate(side // 2, side // 2, RADIUS, 0.8)
    overhead = table._replace(floor_xy=floor_xy)
    _, ends, real, patch = gathered(overhead, image, candidate)
    pixels = np.bincount(np.repeat(np.arange(SECTORS), np.diff(ends))[real], minlength=SECTORS)
    assert pixels.min() > 0.6 * pixels.max()
    assert pixels.sum() > 1000
    rows = patch["pixel"][: ends[SECTORS]][real] // side
    below, above = side // 2 - rows.min(), rows.max() - side // 2
    assert abs(int(below) - int(above)) <= 0.05 * half_px
    assert min(below, above) > half_px


def test_of_huge_discs_pixels_all_around_are_taken(published_camera: Camera) -> None:
    """More at the edge than a patch holds."""
    camera = replace(
        published_camera, width=900, height=500, scale_x=1400.0, scale_y=1400.0, offset_x=450.0,
        offset_y=100.0,
    )  # fmt: skip
    floor_xy = floor_positions(camera).astype(np.float32)
    candidate, image = Candidate(450, 250, 0.35, 0.8), np.zeros((500, 900), np.uint8)
    patch = np.zeros(1, PATCH)
    _, ends = gather(image, floor_xy, candidate, 1.0, WHOLE, NOMINAL, patch[0])
    assert ends[SECTORS] <= CAPACITY
    index = patch["pixel"][0, : ends[SECTORS]][patch["weight"][0, : ends[SECTORS]] == 1.0]
    assert len(set(index)) == len(index)
    every = np.array(pixels_within_reach(floor_xy, candidate, WHOLE, 1.0))
    off = (floor_xy.reshape(-1, 2)[every] - floor_xy[250, 450]) / 0.35
    edge = np.abs(np.hypot(*off.T) - 1.0) < 0.005
    sector = np.floor(np.arctan2(off[:, 1], off[:, 0]) / (2.0 * np.pi) * SECTORS).astype(int)
    shares = [np.isin(every[edge & (sector == s)], index).mean() for s in np.unique(sector)]
    assert min(shares) > 0.7 * max(shares) > 0.1
    # Of all pixels at the edge, neighbours are taken: their correlation counts.
    assert np.isin(index + 1, index).mean() > 0.2
