"""Rows of centres that are left out where what is found is fitted: none too many, and no disc."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from camera import Camera, parse_camera
from detect.circles import CircleDetections, detect_circles, disc_shape, quality_of_centres
from detect.discs.candidates import best_centres, local_maxima
from detect.discs.centre_rows import centre_rows
from detect.settings import CircleSettings
from lut import DiscTable, build_disc_table
from tests.camera.strategies import cameras
from tests.conftest import PUBLISHED_CAM
from tests.detect.painted_floor import LIGHT, PaintedFloor

CAMERA = parse_camera(PUBLISHED_CAM)
DEFAULT = CircleSettings()
EVERY_ROW = replace(DEFAULT, rows_apart=0.0)


@lru_cache(maxsize=4)
def table_of(camera: Camera, circles: CircleSettings = DEFAULT) -> DiscTable:
    return build_disc_table(camera, disc_shape(circles))


def detect(image: NDArray[np.uint8], circles: CircleSettings) -> CircleDetections:
    return detect_circles(image, CAMERA, table_of(CAMERA, circles), circles)


def rows_looked_at(table: DiscTable, apart_m: float) -> list[int]:
    rows: list[int] = np.unique(table.block_row[centre_rows(table, apart_m).blocks]).tolist()
    return rows


def test_every_row_is_looked_at_unless_asked_otherwise() -> None:
    table = table_of(CAMERA)
    every = centre_rows(table, 0.0)
    assert np.array_equal(every.blocks, np.arange(len(table.block_row)))
    assert np.all(np.diff(every.rank) == 1)


def test_more_rows_are_left_out_where_discs_are_nearer() -> None:
    table = table_of(CAMERA)
    rows = np.array(rows_looked_at(table, 0.03))
    apart = np.diff(rows)
    assert apart[0] == 1
    assert apart[-2] >= 5
    # Each distance between rows comes before the larger ones, but for where the image ends.
    assert np.all(np.diff(apart[:-1]) >= 0)
    assert len(rows) < 0.6 * len(rows_looked_at(table, 0.0))


@given(cameras(), st.floats(0.001, 0.2))
@settings(max_examples=10, deadline=None)
def test_no_usable_centre_is_too_far_from_the_rows_looked_at(
    camera: Camera, apart_m: float
) -> None:
    table = build_disc_table(camera, disc_shape(DEFAULT))
    looked_at = centre_rows(table, apart_m)
    some = np.zeros(camera.height, bool)
    some[np.flatnonzero(np.diff(looked_at.rank, prepend=0))] = True
    assert looked_at.blocks.tolist() == np.flatnonzero(some[table.block_row]).tolist()
    # From a centre in a row left out, the nearest row looked at is less than `apart_m` away, or
    # half of two neighbouring rows.
    rows = np.flatnonzero(some)
    left_out = np.unique(table.block_row[~some[table.block_row]])
    floor = table.floor_xy.astype(np.float64)
    for v in left_out.tolist():
        off = int(np.abs(rows - v).min())
        columns = np.flatnonzero(table.usable[v])[::16]
        columns = columns[(columns > 0) & (columns < camera.width - 1)]
        by_u = 0.5 * (floor[v, columns + 1] - floor[v, columns - 1])
        by_v = 0.5 * (floor[v + 1, columns] - floor[v - 1, columns])
        length = np.linalg.norm(by_u, axis=1)
        # How far the next row's line of sight is from this one, where they meet the floor.
        apart = np.abs(by_u[:, 0] * by_v[:, 1] - by_u[:, 1] * by_v[:, 0]) / length
        assert np.all(off * apart <= 1.1 * apart_m)


def test_best_centres_are_the_maxima_among_the_rows_looked_at() -> None:
    table = table_of(CAMERA)
    looked_at = centre_rows(table, 0.03)
    rng = np.random.default_rng(3)
    coarse = rng.integers(0, 256, (CAMERA.height // 8, CAMERA.width // 16), dtype=np.uint8)
    image = np.kron(coarse, np.ones((8, 16), np.uint8))
    found = best_centres(image, table, 0.4, "any", looked_at)
    rows = np.flatnonzero(np.diff(looked_at.rank, prepend=0))
    quality, contrast = quality_of_centres(image, table)
    columns, rank = local_maxima(quality[rows], 0.4)
    assert len(columns) > 100
    np.testing.assert_array_equal(found[0], np.column_stack([columns, rows[rank]]))
    np.testing.assert_array_equal(found[1], quality[rows[rank], columns])
    np.testing.assert_array_equal(found[2], contrast[rows[rank], columns])


@pytest.mark.parametrize("y", np.linspace(-1.25, -0.95, 13).tolist())
def test_discs_between_the_rows_are_found_where_they_are(y: float) -> None:
    floor = PaintedFloor(CAMERA)
    place = np.array([0.03, y])
    floor.disc(place, LIGHT)
    noise = np.random.default_rng(7).normal(0.0, 3.0, (CAMERA.height, CAMERA.width))
    image = np.clip(np.rint(floor.image() + noise), 0, 255).astype(np.uint8)
    some, every = detect(image, DEFAULT), detect(image, EVERY_ROW)
    assert len(some) == len(every) == 1
    assert np.linalg.norm(some.floor_xy - place) < 0.002
    # Another start, nearly the same end: of discs as large as this the fit takes some pixels only.
    deviation = np.sqrt(np.linalg.eigvalsh(every.covariance[0])[0])
    assert np.linalg.norm(some.floor_xy - every.floor_xy) < 0.7 * deviation
    assert some.quality[0] > 0.9


@pytest.mark.parametrize("verify", [True, False])
def test_where_the_pixel_is_the_result_every_row_is_looked_at(verify: bool) -> None:
    floor = PaintedFloor(CAMERA)
    floor.disc(np.array([0.03, -1.1]), LIGHT)
    image = floor.image()
    some = detect(image, replace(DEFAULT, verify=verify, refine=False))
    every = detect(image, replace(EVERY_ROW, verify=verify, refine=False))
    np.testing.assert_array_equal(some.pixels, every.pixels)
    np.testing.assert_array_equal(some.quality, every.quality)
