"""Disc tables against a plain computation of the same, pixel by pixel."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, event, given
from hypothesis import strategies as st

from camera import Camera
from detect.projection import circle_on_floor
from lut import DiscShape, DiscTable, TableError, build_disc_table
from lut.outlines import floor_positions
from redetect.array_types import BoolArray, IntArray
from redetect.landmarks import read_frames
from tests.camera.strategies import cameras, largest_distorted_radius
from tools.benchmark.material import scaled_camera

# -- the reference --------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Outlines:
    """What a table says, without its economies: (H, W, 2 samples) pixels around every pixel.

    `doubtful` if a sample falls so near to the border of two pixels that rounding decides.
    """

    column: IntArray
    row: IntArray
    inside: BoolArray
    usable: BoolArray
    doubtful: bool


def plain_outlines(camera: Camera, shape: DiscShape) -> Outlines:
    """The definition: floor position -> ring -> image -> nearest pixel."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    floor_xy = camera.floor_from_pixel(np.stack([u, v], axis=-1).astype(float))
    radii = shape.inner_radius_m, shape.outer_radius_m
    rings = [circle_on_floor((0.0, 0.0), radius, shape.samples) for radius in radii]
    seen = camera.project_floor(floor_xy[:, :, None] + np.concatenate(rings))
    with np.errstate(invalid="ignore"):
        nearest = np.floor(seen + 0.5)
        doubtful = bool(np.any(np.abs(seen + 0.5 - np.rint(seen + 0.5)) < 1e-9))
        inside = np.all((nearest >= 0) & (nearest < [camera.width, camera.height]), axis=-1)
        per_row = np.hypot(*np.moveaxis(np.gradient(floor_xy, axis=0), -1, 0))
        usable = per_row <= shape.far_limit_m_per_px
    border = shape.border_px
    usable &= (u >= border) & (u <= camera.width - border)
    usable &= (v >= border) & (v <= camera.height - border)
    for outline in (inside[..., : shape.samples], inside[..., shape.samples :]):
        usable &= 2 * outline.sum(axis=-1) >= shape.samples
    nearest = np.where(inside[..., None], nearest, -1.0).astype(np.int64)
    return Outlines(nearest[..., 0], nearest[..., 1], inside, usable, doubtful)


def assert_table_is(table: DiscTable, plain: Outlines) -> None:
    """Bit for bit, for all usable centres."""
    height, width = plain.usable.shape
    assert np.array_equal(table.usable, plain.usable)
    v, u = np.nonzero(plain.usable)
    assert np.array_equal(table.pixels, np.stack([u, v], axis=1))
    expected = np.where(plain.inside, plain.row * width + plain.column, height * width)[v, u]
    samples = expected.shape[1] // 2
    order = np.concatenate([np.arange(0, samples, 2), np.arange(1, samples, 2)])
    pairs = np.stack([expected[:, :samples], expected[:, samples:]], axis=-1)
    assert np.array_equal(table.samples, pairs[:, order])


# -- the published calibration --------------------------------------------------------------------


@pytest.fixture(scope="module")
def published_table(published_camera: Camera) -> DiscTable:
    return build_disc_table(published_camera, DiscShape())


@pytest.fixture(scope="module")
def small_camera(published_camera: Camera) -> Camera:
    """The published camera at a quarter of the image size: a sixteenth of the work."""
    return scaled_camera(published_camera, 1 / 4)


def test_the_published_table_is_what_a_plain_computation_says(small_camera: Camera) -> None:
    table = build_disc_table(small_camera, DiscShape())
    assert_table_is(table, plain_outlines(small_camera, DiscShape()))


@pytest.mark.parametrize(
    "lens",
    [
        {"coef": (0.0,) * 5, "polynomial": (-0.28, 0.074, 0.0)},
        {"tangential": (2e-3, -3e-3), "polynomial": (-0.05, 0.02, -0.004)},
    ],
)
def test_a_table_with_browns_terms_is_what_a_plain_computation_says(
    small_camera: Camera, lens: dict[str, Any]
) -> None:
    camera = dataclasses.replace(small_camera, **lens)
    table = build_disc_table(camera, DiscShape())
    assert_table_is(table, plain_outlines(camera, DiscShape()))
    assert not np.array_equal(table.usable, build_disc_table(small_camera, DiscShape()).usable)
    seen = camera.floor_from_pixel([[0, 71], [191, 71], [96, 50]])
    found = floor_positions(camera)[[71, 71, 50], [0, 191, 96]]
    np.testing.assert_allclose(found, seen, rtol=1e-12)


def test_the_published_limits_are_those_of_the_shipped_file(published_table: DiscTable) -> None:
    rows, columns = np.nonzero(published_table.usable)
    assert (rows.min(), rows.max()) == (116, 276)
    assert (columns.min(), columns.max()) == (12, 756)


def test_every_shipped_centre_is_usable(
    published_camera: Camera, published_table: DiscTable, shared_data: Path
) -> None:
    frames = read_frames(shared_data / "dlr" / "map.circles")
    shipped = np.array([(disc.px, disc.py) for frame in frames for disc in frame.circles])
    pixels = np.rint(published_camera.project_floor(shipped)).astype(int)
    assert len(pixels) == 14745
    assert published_table.usable[pixels[:, 1], pixels[:, 0]].all()
    # The file's own near and far limits: its first and last rows are the table's.
    assert (pixels[:, 1].min(), pixels[:, 1].max()) == (116, 276)
    assert (pixels[:, 0].min(), pixels[:, 0].max()) == (15, 755)


def test_the_floor_positions_are_the_camera_s(
    published_camera: Camera, published_table: DiscTable
) -> None:
    floor_xy = floor_positions(published_camera)
    assert floor_xy.shape == (288, 768, 2)
    for u, v in ((0, 287), (767, 287), (384, 200), (100, 130)):
        assert floor_xy[v, u] == pytest.approx(published_camera.floor_from_pixel([u, v]), rel=1e-12)
    assert np.isnan(floor_xy[0, 384]).all()
    assert np.array_equal(published_table.floor_xy, floor_xy.astype(np.float32), equal_nan=True)


@pytest.mark.parametrize(
    "shape",
    [
        DiscShape(inner_radius_m=0.03, outer_radius_m=0.05, samples=3, border_px=0),
        DiscShape(inner_radius_m=0.2, outer_radius_m=0.9, samples=33, far_limit_m_per_px=0.5),
    ],
)
def test_other_radii_and_sample_counts(small_camera: Camera, shape: DiscShape) -> None:
    table = build_disc_table(small_camera, shape)
    assert table.usable.any()
    assert_table_is(table, plain_outlines(small_camera, shape))


# -- any camera -----------------------------------------------------------------------------------


@st.composite
def shapes(draw: st.DrawFn) -> DiscShape:
    inner = draw(st.floats(0.01, 1.0))
    return DiscShape(
        inner_radius_m=inner,
        outer_radius_m=inner * draw(st.floats(1.1, 5.0)),
        samples=draw(st.integers(3, 20)),
        border_px=draw(st.integers(0, 6)),
        far_limit_m_per_px=draw(st.floats(0.001, 5.0)),
    )


@given(cameras(largest_side=60))
def test_any_camera_s_floor_is_that_of_its_pixels(camera: Camera) -> None:
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    pixels = np.stack([u, v], axis=-1).astype(float)
    expected = camera.floor_from_pixel(pixels)
    floor_xy = floor_positions(camera)
    assert floor_xy.dtype == np.float64
    down = -camera.directions_robot(pixels)[..., 2]
    assume(np.abs(down).min() > 1e-9)  # at the horizon itself rounding decides
    assert np.array_equal(np.isnan(floor_xy), np.isnan(expected))
    # Rounding of a direction moves its end the more, the flatter it comes down.
    met = down > 0.0
    tolerance = 1e-13 * np.linalg.norm(expected[met] - camera.centre[:2], axis=-1) / down[met]
    tolerance += 1e-13 * np.abs(camera.centre).sum()
    error = np.linalg.norm(floor_xy[met] - expected[met], axis=-1)
    assert np.all(error <= tolerance)


def test_close_to_the_fold_the_floor_is_right_too() -> None:
    # The image's corner lies where the distortion all but folds: no polynomial follows it there.
    coef = (0.0, -0.2, 0.0, 0.0, 0.0)
    scale = math.hypot(30.0, 20.0) / largest_distorted_radius(coef) * (1.0 + 1e-9)
    camera = Camera(
        width=61, height=41, scale_x=scale, scale_y=scale, offset_x=30.0, offset_y=20.0, coef=coef,
        robot_from_camera=((-1.0, 0, 0, 0.0), (0, 1.0, 0, 0.0), (0, 0, -1.0, 1.5)),
    )  # fmt: skip
    v, u = np.mgrid[0:41, 0:61]
    expected = camera.floor_from_pixel(np.stack([u, v], axis=-1).astype(float))
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(floor_positions(camera), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 5), (130, 1), (64, 64), (65, 3)])
def test_images_of_any_size_have_tables(width: int, height: int) -> None:
    camera = Camera(
        width=width, height=height, scale_x=60.0, scale_y=60.0,
        offset_x=(width - 1) / 2, offset_y=(height - 1) / 2, coef=(0.0, -0.1, 0.0, 0.2, 0.0),
        robot_from_camera=((-1.0, 0, 0, 0.0), (0, 1.0, 0, 0.0), (0, 0, -1.0, 1.5)),
    )  # fmt: skip
    # A pixel is 25 mm: in an image of one column the outlines have to stay within it.
    outer_m = 0.011 if width == 1 else 0.04
    shape = DiscShape(0.01, outer_m, samples=6, border_px=0, far_limit_m_per_px=1.0)
    table = build_disc_table(camera, shape)
    # A single row has no row next to it from which the far limit could be told.
    assert table.usable.any() == (height > 1)
    assert table.floor_xy.shape == (height, width, 2)
    if height > 1:
        assert_table_is(table, plain_outlines(camera, shape))


@given(cameras(largest_side=40, down_deg=(-10.0, 90.0)), shapes())
def test_any_camera_s_table_is_what_a_plain_computation_says(
    camera: Camera, shape: DiscShape
) -> None:
    plain = plain_outlines(camera, shape)
    assume(not plain.doubtful)
    event(f"usable centres: {plain.usable.any()}")
    assert_table_is(build_disc_table(camera, shape), plain)


def wide_and_low() -> Camera:
    """Sees 160 deg across, 15 cm above the floor: rings reach behind it and past the fold."""
    return Camera(
        width=60, height=40, scale_x=20.0, scale_y=20.0, offset_x=30.0, offset_y=20.0,
        coef=(0.0, -0.2, 0.0, 0.5, 0.0),
        robot_from_camera=((-1.0, 0, 0, 0.0), (0, 0.6, -0.8, 0.0), (0, -0.8, -0.6, 0.15)),
    )  # fmt: skip


def test_samples_that_the_camera_cannot_see_at_all_do_not_vote() -> None:
    camera = wide_and_low()
    shape = DiscShape(0.1, 0.5, samples=16, border_px=0, far_limit_m_per_px=1.0)
    table = build_disc_table(camera, shape)
    rings = np.concatenate([circle_on_floor((0.0, 0.0), radius, 16) for radius in (0.1, 0.5)])
    undefined = np.isnan(camera.project_floor(table.floor_xy[:, :, None] + rings)).any(axis=-1)
    assert (undefined & table.usable[..., None]).any()
    assert_table_is(table, plain_outlines(camera, shape))


def test_a_camera_that_looks_up_gets_an_empty_table(published_camera: Camera) -> None:
    up = dataclasses.replace(
        published_camera, robot_from_camera=((-1.0, 0, 0, 0.0), (0, 1.0, 0, 0.0), (0, 0, -1.0, 1.5))
    )
    assert build_disc_table(up, DiscShape()).usable.any()  # straight down, the same mount
    up = dataclasses.replace(
        published_camera, robot_from_camera=((1.0, 0, 0, 0.0), (0, 1.0, 0, 0.0), (0, 0, 1.0, 1.5))
    )
    table = build_disc_table(up, DiscShape())
    assert not table.usable.any()
    assert table.samples.shape == (0, 16, 2)
    assert len(table.pixels) == 0
    assert np.isnan(table.floor_xy).all()


@pytest.mark.parametrize("height_m", [0.0, -1.5])
def test_a_camera_that_is_not_above_the_floor_is_refused(
    published_camera: Camera, height_m: float
) -> None:
    pose = np.array(published_camera.robot_from_camera)
    pose[2, 3] = height_m
    below = dataclasses.replace(
        published_camera,
        robot_from_camera=tuple((row[0], row[1], row[2], row[3]) for row in pose.tolist()),
    )
    with pytest.raises(TableError, match="above the floor: expected more than 0"):
        build_disc_table(below, DiscShape())


def test_rings_are_equally_spaced_circles_that_begin_to_the_left() -> None:
    points = circle_on_floor((0.0, 0.0), 0.14, 16)
    assert np.hypot(*points.T) == pytest.approx(0.14)
    assert points[0] == pytest.approx([0.14, 0.0])
    assert points[4] == pytest.approx([0.0, 0.14])
    gaps = np.hypot(*(points - np.roll(points, 1, axis=0)).T)
    assert gaps == pytest.approx(2 * 0.14 * np.sin(np.pi / 16))
