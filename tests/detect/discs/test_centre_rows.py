"""Rows of centres that are left out where what is found is fitted: none too many, and no disc."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from camera import Camera, parse_camera
from detect.circles import CircleDetections, detect_circles, disc_shape
from detect.settings import CircleSettings
from lut import DiscTable, build_disc_table
from tests.camera.strategies import cameras
from tests.detect.painted_floor import LIGHT, PaintedFloor
from tools.published_camera import PUBLISHED_CAM

CAMERA = parse_camera(PUBLISHED_CAM)
DEFAULT = CircleSettings()
EVERY_ROW = replace(DEFAULT, rows_apart=0.0)


@lru_cache(maxsize=4)
def table_of(camera: Camera, circles: CircleSettings = DEFAULT) -> DiscTable:
    return build_disc_table(camera, disc_shape(circles))


def detect(image: NDArray[np.uint8], circles: CircleSettings) -> CircleDetections:
    return detect_circles(image, CAMERA, table_of(CAMERA, circles), circles)


def rows_tested(camera: Camera, apart_m: float) -> list[int]:
    shape = replace(disc_shape(EVERY_ROW), rows_m=apart_m)
    rows: list[int] = np.unique(build_disc_table(camera, shape).pixels[:, 1]).tolist()
    return rows


def test_every_row_is_tested_unless_asked_otherwise() -> None:
    table = table_of(CAMERA, EVERY_ROW)
    assert np.all(np.diff(rows_tested(CAMERA, 0.0)) == 1)
    assert np.count_nonzero(table.usable) == len(table.pixels)
    assert np.all(np.diff(table.pixels[table.pixels[:, 1] == 200, 0]) == 1)


def test_more_rows_are_left_out_where_discs_are_nearer() -> None:
    rows = np.array(rows_tested(CAMERA, 0.03))
    apart = np.diff(rows)
    assert apart[0] == 1
    assert apart[-2] >= 5
    # Each distance between rows comes before the larger ones, but for where the image ends.
    assert np.all(np.diff(apart[:-1]) >= 0)
    assert len(rows) < 0.6 * len(rows_tested(CAMERA, 0.0))


#: Pixels at its sides see many times as much of the floor as those in the middle.
WIDE = replace(
    CAMERA,
    width=1159,
    height=1072,
    scale_x=206.7,
    scale_y=208.7,
    offset_x=765.0,
    offset_y=727.6,
    coef=(0.24255, -0.29225, 0.83097, -0.18043, 0.18638),
    robot_from_camera=(
        (0.030889, 0.954701, -0.29596, -0.622862),
        (-0.060992, 0.29735, 0.952818, 0.283688),
        (0.99766, -0.011381, 0.067414, 1.1),
    ),
)


@given(cameras(), st.floats(0.001, 0.2))
@example(WIDE, 0.136)
@settings(max_examples=2)
def test_no_usable_centre_is_too_far_from_those_tested(camera: Camera, apart_m: float) -> None:
    shape = replace(disc_shape(EVERY_ROW), rows_m=apart_m, stride_m=apart_m)
    some = build_disc_table(camera, shape)
    every = build_disc_table(camera, disc_shape(EVERY_ROW))
    rows = np.unique(some.pixels[:, 1])
    assume(len(rows) > 0)  # images of a few pixels may show no whole disc in any row tested
    floor = every.floor_xy.astype(np.float64)
    for v in np.unique(every.pixels[:, 1]).tolist():
        columns = np.flatnonzero(every.usable[v])[::16]
        columns = columns[(columns > 0) & (columns < camera.width - 1)]
        by_u = 0.5 * (floor[v, columns + 1] - floor[v, columns - 1])
        by_v = floor[min(v + 1, camera.height - 1), columns] - floor[max(v - 1, 0), columns]
        by_v /= min(v + 1, camera.height - 1) - max(v - 1, 0)
        length = np.linalg.norm(by_u, axis=1)
        if v in rows:
            # The next tested centre is at most half a stride away, more where pixels grow along the
            # row, or the next pixel.
            tested = np.flatnonzero(some.usable[v])
            between = (columns >= tested[0]) & (columns <= tested[-1])
            off = np.abs(columns[:, None] - tested).min(axis=1)
            assert np.all((off * length)[between] <= 0.9 * apart_m + length[between])
        elif rows[0] < v < rows[-1]:
            # How far the next row's line of sight is from this one, where they meet the floor.
            across = np.abs(by_u[:, 0] * by_v[:, 1] - by_u[:, 1] * by_v[:, 0]) / length
            assert np.all(np.abs(rows - v).min() * across <= 1.1 * apart_m)


@pytest.mark.parametrize("y", np.linspace(-1.25, -0.95, 7).tolist())
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
