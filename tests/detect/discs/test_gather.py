"""Which pixels a disc is fitted to, held against their definition; and who is looked at at all."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from camera import Camera
from detect.circles import disc_shape
from detect.discs.candidate_kernels import share_of_steps
from detect.discs.fit import fit_settings
from detect.discs.list_kernels import gather_list
from detect.discs.model_kernels import CAPACITY, GEOMETRY
from detect.discs.patch_kernels import (
    GREY,
    LINKED,
    NEAR,
    ONE,
    PLANE_X,
    PLANE_Y,
    TERMS,
    WHOLE,
    FitSettings,
    Patch,
    new_patch,
    padded,
)
from detect.settings import CircleSettings
from lut import DiscTable, build_disc_table
from tests.detect.painted_floor import PaintedFloor

RADIUS = 0.1


@pytest.fixture(scope="module")
def table(published_camera: Camera) -> DiscTable:
    return build_disc_table(published_camera, disc_shape(CircleSettings()))


@njit(error_model="numpy")
def gathered(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u: int,
    v: int,
    settings: FitSettings,
    half: int,
    every: int,
) -> tuple[int, Patch]:
    """`gather_list` into a patch that was used before."""
    patch = new_patch()
    patch.terms[:] = 7.0
    patch.geometry[:] = 7.0
    return gather_list(
        image, floor_xy, u, v, RADIUS, 0.8, settings, half, half, every, patch
    ), patch


def test_lists_are_the_pixels_within_reach(table: DiscTable) -> None:
    image = np.random.default_rng(3).integers(0, 256, table.floor_xy.shape[:2], np.uint8)
    settings = fit_settings(1.0, 0.5)
    u0, v0 = 400, 200
    n, patch = gathered(image, table.floor_xy, u0, v0, settings, 50, 1)
    index = patch.pixels[:n].astype(int)
    assert np.all(np.diff(index) > 0)
    floor = table.floor_xy.astype(float)
    off = np.linalg.norm(floor - floor[v0, u0], axis=-1)
    inside = (off <= settings.reach_radii * RADIUS).ravel()
    # The reach in pixels adds nothing to a disc as near as this one.
    unsure = (np.abs(off - settings.reach_radii * RADIUS) < 1e-6).ravel()
    expected = np.flatnonzero(inside & ~unsure)
    assert len(expected) > 500
    assert set(expected) <= set(index) <= set(np.flatnonzero(inside | unsure))
    terms = patch.terms.reshape(TERMS, CAPACITY)
    rows, columns = np.divmod(index, image.shape[1])
    place = (floor[rows, columns] - floor[v0, u0]) / RADIUS
    np.testing.assert_allclose(terms[[PLANE_X, PLANE_Y], :n].T, place, atol=1e-5)
    np.testing.assert_array_equal(terms[GREY, :n], image[rows, columns].astype(int) - image[v0, u0])
    np.testing.assert_array_equal(terms[LINKED, 1:n], np.diff(index) == 1)
    np.testing.assert_array_equal(terms[NEAR, :n], off[rows, columns] <= 1.45 * RADIUS)
    np.testing.assert_array_equal(terms[ONE, :n], 1.0)
    # What fills up the list is nowhere.
    whole = padded(n)
    assert n <= whole < n + WHOLE
    assert whole % WHOLE == 0
    np.testing.assert_array_equal(terms[:, n:whole], 0.0)
    assert np.all(patch.geometry.reshape(GEOMETRY, CAPACITY)[0, n:whole] > 100.0)


def test_sparse_lists_keep_the_edge_and_some_of_the_others(table: DiscTable) -> None:
    image = np.zeros(table.floor_xy.shape[:2], np.uint8)
    settings = fit_settings(1.0, 0.5)
    n, patch = gathered(image, table.floor_xy, 400, 200, settings, 50, 1)
    every = set(patch.pixels[:n].astype(int))
    m, patch = gathered(image, table.floor_xy, 400, 200, settings, 50, 8)
    index = patch.pixels[:m].astype(int)
    weight = patch.pixels[CAPACITY : CAPACITY + m]
    assert len(set(index)) == m
    assert set(index) <= every
    at_edge = weight == 1
    off = np.linalg.norm(table.floor_xy.reshape(-1, 2)[index] - table.floor_xy[200, 400], axis=-1)
    assert np.all(np.abs(off[at_edge] / RADIUS - 1.0) < 0.5)
    # The others stand for eight pixels each, those far from the disc for none.
    assert set(weight[~at_edge]) == {0, 8}
    assert (~at_edge).sum() == pytest.approx((n - at_edge.sum()) / 8, rel=0.1)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_discs_step_on_all_sides_and_edges_on_some(
    published_camera: Camera, table: DiscTable, sign: float
) -> None:
    place = (0.3, -1.8)
    u, v = np.rint(published_camera.project_floor(np.array(place))).astype(int)
    grey = 140.0 - 60.0 * sign, 140.0 + 60.0 * sign
    disc = PaintedFloor(published_camera, grey[0]).disc(place, grey[1], RADIUS, 0.7).image(2.0)
    outlines = 0.06, 0.14
    assert share_of_steps(disc, table.floor_xy, u, v, *outlines, 120.0 * sign) == 1.0
    assert share_of_steps(disc, table.floor_xy, u, v, *outlines, -120.0 * sign) == 0.0
    # A line of one radius to either side of the middle: none along it.
    stripe = np.full_like(disc, round(grey[0]))
    off = np.abs(table.floor_xy[..., 0] - place[0])
    stripe[off < RADIUS] = round(grey[1])
    share = share_of_steps(stripe, table.floor_xy, u, v, *outlines, 120.0 * sign)
    assert share == pytest.approx(0.5, abs=0.13)
    # In the image's corner few directions are seen, or none.
    assert share_of_steps(np.zeros_like(disc), table.floor_xy, 0, 287, 5.0, 9.0, 50.0) == 1.0
