"""Rendered single discs against brute-force rays and against the disc's true place."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from tests.pictures import centroid
from tools.simulator import single_disc
from tools.simulator.single_disc import polygon_coverage, render_disc

RADIUS_M = 0.10
PLACES = [(0.1, -0.9), (-0.35, -1.4), (0.8, -2.1), (-1.1, -2.8), (0.2, -3.9), (0.9, -0.75)]


def _traced_share(
    camera: Camera,
    floor_xy: tuple[float, float],
    shape: tuple[int, int],
    offset: tuple[int, int],
    per_axis: int,
) -> NDArray[np.float64]:
    """Share of each pixel's area whose rays meet the disc: rays backward, one by one."""
    fine = (np.arange(per_axis) + 0.5) / per_axis - 0.5
    u = (offset[0] + np.arange(shape[1]))[:, None] + fine
    v = (offset[1] + np.arange(shape[0]))[:, None] + fine
    uv = np.stack(np.meshgrid(u.ravel(), v.ravel()), axis=-1)
    inside = np.hypot(*np.moveaxis(camera.floor_from_pixel(uv) - floor_xy, -1, 0)) <= RADIUS_M
    return np.asarray(inside.reshape(shape[0], per_axis, shape[1], per_axis).mean(axis=(1, 3)))


@pytest.mark.parametrize("floor_xy", PLACES)
def test_share_is_that_of_traced_rays(
    published_camera: Camera, floor_xy: tuple[float, float]
) -> None:
    share, (rows, columns) = render_disc(published_camera, floor_xy, RADIUS_M, light=1.0, dark=0.0)
    corner = columns.start, rows.start
    traced = _traced_share(published_camera, floor_xy, share.shape, corner, 40)
    # 40 x 40 rays place the outline within 1/80 px.
    assert np.abs(share - traced).max() < 0.02
    assert np.abs(centroid(share) - centroid(traced)).max() < 1e-3


@pytest.mark.parametrize(
    ("cells", "blur_px", "within"), [(1, 0.0, 1e-12), (3, 0.0, 1e-12), (40, (0.8, 0.4), 5e-4)]
)
def test_number_of_cells_hardly_matters(
    published_camera: Camera,
    monkeypatch: pytest.MonkeyPatch,
    cells: int,
    blur_px: float | tuple[float, float],
    within: float,
) -> None:
    disc = published_camera, (0.2, -3.0), RADIUS_M, 1.0, 0.0, blur_px
    usual = render_disc(*disc).grey
    monkeypatch.setattr(single_disc, "_CELLS", cells)
    np.testing.assert_allclose(render_disc(*disc).grey, usual, atol=within)


@pytest.mark.parametrize("blur_px", [0.6, (1.2, 0.6), 1.2])
def test_blur_keeps_area_and_centroid(
    published_camera: Camera, blur_px: float | tuple[float, float]
) -> None:
    sharp, blurred = (
        render_disc(published_camera, (-0.5, -2.0), RADIUS_M, 1.0, 0.0, blur_px=b).grey
        for b in (0.0, blur_px)
    )
    assert blurred.max() <= 1.0
    assert np.abs(sharp - blurred).max() > 0.05
    assert blurred.sum() == pytest.approx(sharp.sum(), rel=1e-6)
    np.testing.assert_allclose(centroid(blurred), centroid(sharp), atol=5e-4)


def test_blur_reaches_in_from_beyond_the_border(published_camera: Camera) -> None:
    at_border = published_camera.floor_from_pixel([0.0, 200.0])
    cut = render_disc(published_camera, at_border, RADIUS_M, 1.0, 0.0, (2.0, 0.2))
    assert cut.window[1].start == 0
    row = cut.grey[round(200 - cut.window[0].start)]
    # Only one side of the disc is in the image; its inside must not darken towards the border.
    assert row[0] > 0.99


def test_refusals(published_camera: Camera) -> None:
    with pytest.raises(ValueError, match="not wholly in front"):
        render_disc(published_camera, (0.0, 3.0))
    with pytest.raises(ValueError, match="not in the image"):
        render_disc(published_camera, (0.0, -0.3))


def test_polygon_coverage_of_known_areas() -> None:
    # A parallelogram whose edges cross cells: area and centroid in closed form.
    x, y = np.array([1.25, 6.75, 8.5, 3.0]), np.array([0.5, 1.125, 5.875, 5.25])
    shares = polygon_coverage(x, y, 10, 7)
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    assert shares.sum() == pytest.approx(-area, abs=1e-12)
    assert shares.min() * np.sign(shares.sum()) >= -1e-12
    assert np.abs(shares).max() <= 1.0 + 1e-12
    row, column = np.indices(shares.shape) + 0.5
    # Cells are integrated exactly, their centroids are not: half a cell is the bound.
    assert (shares * column).sum() / shares.sum() == pytest.approx(x.mean(), abs=0.05)
    assert (shares * row).sum() / shares.sum() == pytest.approx(y.mean(), abs=0.05)
    # One half-covered cell.
    corner = polygon_coverage(np.array([2.0, 3.0, 2.0]), np.array([1.0, 1.0, 2.0]), 5, 4)
    assert abs(corner[1, 2]) == pytest.approx(0.5)
    assert np.abs(corner).sum() == pytest.approx(0.5)
