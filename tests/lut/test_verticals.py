"""The table of verticals against points in space projected through the camera."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera import Camera
from lut.verticals import STEEPEST_SLOPE, VerticalTable, build_vertical_table
from tests.detect.line_scene import mirrored, pinhole

BARREL = (0.0, -0.08, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def published_table(published_camera: Camera) -> VerticalTable:
    return build_vertical_table(published_camera)


@pytest.fixture(scope="module", params=["radial", "decentred"])
def camera(request: pytest.FixtureRequest, published_camera: Camera) -> Camera:
    if request.param == "radial":
        return published_camera
    terms = {"tangential": (2e-3, -3e-3), "polynomial": (-0.05, 0.02, -0.004)}
    return dataclasses.replace(published_camera, **terms)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def table(camera: Camera) -> VerticalTable:
    return build_vertical_table(camera)


def strip_points(table: VerticalTable, c: int) -> np.ndarray:
    rows = np.arange(table.first_row[c], table.last_row[c] + 1)
    return np.stack([table.column[rows, c].astype(np.float64), rows.astype(np.float64)], axis=-1)


def test_horizon_is_where_directions_are_level(camera: Camera, table: VerticalTable) -> None:
    assert table.anchor_elevation_rad == 0.0
    columns = np.arange(camera.width, dtype=np.float64)
    seen = camera.directions_robot(np.stack([columns, table.anchor_row], axis=-1))
    np.testing.assert_allclose(seen[:, 2] / np.hypot(*seen[:, :2].T), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.arctan2(seen[:, 0], -seen[:, 1]), table.bearing_rad, atol=1e-12)


@pytest.mark.parametrize("c", [5, 130, 384, 600, 760])
def test_points_on_a_vertical_project_onto_its_columns(
    camera: Camera, table: VerticalTable, c: int
) -> None:
    bearing = table.bearing_rad[c]
    rows = np.arange(table.first_row[c], table.last_row[c] + 1)
    height = 2.5 * table.elevation_tan[rows, c].astype(np.float64)
    foot = camera.centre[:2] + 2.5 * np.array([np.sin(bearing), -np.cos(bearing)])
    points = np.column_stack([np.broadcast_to(foot, (len(rows), 2)), camera.centre[2] + height])
    pixels = camera.project_robot(points)
    # Single precision of the table, at 45 deg of elevation.
    np.testing.assert_allclose(pixels[:, 1], rows, atol=5e-4)
    np.testing.assert_allclose(pixels[:, 0], table.column[rows, c], atol=5e-4)
    assert len(rows) > 150


def test_vertical_passes_through_its_column_on_the_horizon(published_table: VerticalTable) -> None:
    for c in np.flatnonzero(published_table.usable)[5:-5:37]:
        points = strip_points(published_table, int(c))
        at_horizon = np.interp(published_table.anchor_row[c], points[:, 1], points[:, 0])
        # A straight line between rows, on a curve.
        assert at_horizon == pytest.approx(c, abs=2e-3)


@given(
    pitch=st.floats(-30.0, 30.0),
    roll=st.floats(-40.0, 40.0),
    aspect=st.sampled_from([1.0, 2.0]),
    coef=st.sampled_from([(0.0,) * 5, BARREL]),
    tangential=st.sampled_from([(0.0, 0.0), (5e-3, -3e-3)]),
)
@settings(max_examples=25)
def test_any_pose_gives_verticals_inside_the_image(
    pitch: float,
    roll: float,
    aspect: float,
    coef: tuple[float, float, float, float, float],
    tangential: tuple[float, float],
) -> None:
    camera = pinhole(90, 60, 80.0, pitch_deg=pitch, roll_deg=roll, row_aspect=aspect, coef=coef)
    camera = dataclasses.replace(camera, tangential=tangential)
    table = build_vertical_table(camera)
    shown = np.isfinite(table.column)
    assert np.array_equal(shown, np.isfinite(table.elevation_tan))
    rows = np.arange(camera.height)[:, None]
    assert np.array_equal(shown, (rows >= table.first_row) & (rows <= table.last_row))
    assert np.all((table.column[shown] >= 0.0) & (table.column[shown] <= camera.width - 1))
    assert np.all(np.isfinite(table.anchor_row[table.usable]))
    assert np.all(shown[np.rint(table.anchor_row[table.usable]).astype(int), table.usable])
    steep = np.abs(np.diff(table.column.astype(np.float64), axis=0))
    assert not np.any(steep > STEEPEST_SLOPE + 0.02)
    for c in np.flatnonzero(table.usable)[::11]:
        points = strip_points(table, int(c))
        seen = camera.directions_robot(points)
        np.testing.assert_allclose(
            np.arctan2(seen[:, 0], -seen[:, 1]), table.bearing_rad[c], atol=2e-6
        )
        np.testing.assert_allclose(
            seen[:, 2] / np.hypot(seen[:, 0], seen[:, 1]),
            table.elevation_tan[points[:, 1].astype(int), c],
            atol=2e-6,
        )


@pytest.mark.parametrize("pitch", [-32.0, 28.0, 45.0])
@pytest.mark.parametrize("roll", [0.0, 8.0, 180.0])
@pytest.mark.parametrize("coef", [(0.0,) * 5, BARREL])
def test_camera_that_sees_no_horizon_has_a_line_parallel_to_it(
    pitch: float, roll: float, coef: tuple[float, float, float, float, float]
) -> None:
    camera = pinhole(90, 60, 80.0, pitch_deg=pitch, roll_deg=roll, coef=coef)
    table = build_vertical_table(camera)
    # Turned over, it looks up where it looked down.
    looks_down = (pitch > 0.0) == (roll < 90.0)
    assert (table.anchor_elevation_rad < 0.0) == looks_down
    columns = np.flatnonzero(np.isfinite(table.anchor_row))
    assert len(columns) >= 80
    seen = camera.directions_robot(np.stack([columns, table.anchor_row[columns]], axis=-1))
    elevation = np.arctan2(seen[:, 2], np.hypot(seen[:, 0], seen[:, 1]))
    np.testing.assert_allclose(elevation, table.anchor_elevation_rad, atol=1e-9)
    np.testing.assert_allclose(
        np.arctan2(seen[:, 0], -seen[:, 1]), table.bearing_rad[columns], atol=1e-12
    )
    # Inside the image, near the border that is nearer to the horizon.
    border = 0.0 if pitch > 0.0 else camera.height - 1.0
    gap = np.abs(table.anchor_row[columns] - border)
    assert np.median(gap) < 0.25 * camera.height
    assert np.mean(gap >= camera.height / 12.0) >= 0.85


def test_camera_that_looks_far_past_the_horizon_has_no_verticals() -> None:
    for pitch in (-70.0, 70.0):
        table = build_vertical_table(pinhole(90, 60, 80.0, pitch_deg=pitch))
        assert not table.usable.any()
        assert np.all(np.isnan(table.anchor_row))
        assert np.all(np.isnan(table.column))


def test_horizon_that_leaves_the_image_on_one_side_gives_part_of_a_table() -> None:
    camera = pinhole(160, 60, 120.0, pitch_deg=8.0, roll_deg=15.0)
    table = build_vertical_table(camera)
    inside = np.isfinite(table.anchor_row)
    assert 0 < inside.sum() < camera.width
    # One stretch of columns, at one side.
    assert np.count_nonzero(np.diff(inside.astype(int))) == 1
    level = camera.directions_robot(
        np.stack([np.flatnonzero(inside), table.anchor_row[inside]], axis=-1)
    )
    np.testing.assert_allclose(level[:, 2], 0.0, atol=1e-10)


def test_verticals_beyond_45_degrees_are_marked() -> None:
    rolled = build_vertical_table(pinhole(90, 60, 80.0, roll_deg=50.0))
    assert np.isfinite(rolled.anchor_row).any()
    assert not rolled.usable.any()


def test_upside_down_camera_sees_verticals_too() -> None:
    table = build_vertical_table(pinhole(90, 60, 80.0, roll_deg=180.0))
    assert table.usable.all()
    # Left of the image is right of the robot, and up is down.
    assert np.all(np.diff(table.bearing_rad) > 0.0)
    assert np.all(np.diff(table.elevation_tan[:, 45]) > 0.0)


def test_mirrored_camera_gives_the_mirrored_table() -> None:
    camera = pinhole(91, 60, 80.0, pitch_deg=12.0, roll_deg=6.0, coef=BARREL)
    table = build_vertical_table(camera)
    other = build_vertical_table(mirrored(camera))
    np.testing.assert_allclose(other.anchor_row[::-1], table.anchor_row, atol=1e-9)
    np.testing.assert_allclose(other.bearing_rad[::-1], -table.bearing_rad, atol=1e-12)
    np.testing.assert_array_equal(other.first_row[::-1], table.first_row)
    np.testing.assert_allclose(90.0 - other.column[:, ::-1], table.column, atol=2e-5)


def test_half_frames_have_rows_twice_as_high(published_table: VerticalTable) -> None:
    assert published_table.row_aspect == 2.0
