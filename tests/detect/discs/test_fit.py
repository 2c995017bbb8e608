"""The disc fit on single rendered discs: parameters back, limits, and the search around it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from detect.discs.patch import EDGE, Candidate, view_of
from detect.discs.placing import RADIUS_SIGMA, WHOLE
from detect.discs.positions import refined_covariance
from detect.projection import image_positions
from lut import VoteTable
from tests.detect.discs.single_fits import fits_at
from tests.detect.painted_floor import PaintedFloor
from tests.reference.discs import Expected, Pixels, fitted_disc, pixels_within_reach

#: `PaintedFloor` blurs by as many pixels along v as along u.
PAINTED_RATIO = 1.0
#: Of the fit: the blur that is expected, pixels, and the deviation of its logarithm.
BLUR_PX, BLUR_SIGMA = 0.6, 0.7

PLACES = [(0.1, -0.95), (-0.6, -1.6), (0.4, -2.4), (-0.3, -3.6), (0.8, -5.2)]


def nearest(camera: Camera, place: tuple[float, float]) -> NDArray[np.int64]:
    return np.rint(camera.project_floor(np.array(place))).astype(np.int64)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("offset", [(0, 0), (3, -1)])
@pytest.mark.parametrize("blur", [0.5, 1.0, 3.0])
def test_parameters_come_back(
    published_camera: Camera,
    table: VoteTable,
    place: tuple[float, float],
    offset: tuple[int, int],
    blur: float,
) -> None:
    floor = PaintedFloor(published_camera, 60.0).disc(place, 210.0, 0.1, blur)
    pixel = nearest(published_camera, place) + (offset if place[1] > -3.0 else (0, 0))
    fit = fits_at(
        published_camera, floor.image(0.5), table.floor_xy, pixel[None], 0.1, 0.6,
        blur_ratio=PAINTED_RATIO, blur_px=0.8 * blur,
    )  # fmt: skip
    assert fit.converged[0]
    per_px = np.linalg.norm(published_camera.floor_jacobian(pixel.astype(float)), 2)
    # Where the blur is as large as the disc, or larger, perspective within it counts.
    tiny = blur > 2.0 and place[1] < -5.0
    within = 0.4 if tiny else 0.1 if blur > 2.0 else 0.05
    assert np.hypot(*(fit.floor_xy[0] - place)) < within * per_px
    within = 0.25 if tiny else 0.1 if blur > 2.0 else 0.02
    assert fit.radius[0] == pytest.approx(0.1, rel=within)
    if blur < 2.0:
        assert fit.contrast[0] == pytest.approx(150.0, rel=0.1)
    assert fit.explained[0] > (0.9 if tiny else 0.97)


def test_covariance_counts_noise(published_camera: Camera, table: VoteTable) -> None:
    """Monte Carlo: the scatter of fits is what they say it is."""
    place = (0.3, -2.0)
    floor = PaintedFloor(published_camera, 60.0).disc(place, 200.0, 0.1, 0.8)
    pixel = nearest(published_camera, place)[None]
    normalised = []
    for seed in range(150):
        fit = fits_at(
            published_camera, floor.image(4.0, seed), table.floor_xy, pixel, 0.1, 4.0,
            blur_ratio=PAINTED_RATIO,
        )  # fmt: skip
        off = fit.floor_xy[0] - place
        normalised.append(off @ np.linalg.solve(fit.covariance[0], off) / 2.0)
    assert 0.7 < np.mean(normalised) < 1.4


def test_candidates_at_the_image_border(published_camera: Camera, table: VoteTable) -> None:
    image = PaintedFloor(published_camera).image(2.0)
    width, height = published_camera.width, published_camera.height
    pixels = np.array([[0, 150], [width - 1, 150], [0, height - 1], [width - 1, height - 1]])
    fit = fits_at(published_camera, image, table.floor_xy, pixels, 0.1, 2.0, blur_ratio=0.5)
    assert fit.converged.shape == (4,)
    assert np.all(np.isfinite(fit.floor_xy[fit.converged]))


def test_larger_discs_than_a_patch_are_fitted(published_camera: Camera, table: VoteTable) -> None:
    """More pixels than fit into a patch: some are left out, evenly."""
    place = (0.0, -1.5)
    image = PaintedFloor(published_camera, 60.0).disc(place, 200.0, 0.25, 0.8).image(1.0)
    pixel = nearest(published_camera, place)[None]
    fit = fits_at(
        published_camera, image, table.floor_xy, pixel, 0.25, 1.0, blur_ratio=PAINTED_RATIO
    )
    assert fit.converged[0]
    assert np.hypot(*(fit.floor_xy[0] - place)) < 2e-4
    assert fit.radius[0] == pytest.approx(0.25, rel=2e-3)


@pytest.mark.parametrize("tangential", [(0.0, 0.0), (2e-3, -3e-3)])
def test_refined_covariance_is_the_sum(
    published_camera: Camera, tangential: tuple[float, float]
) -> None:
    """The fit's, J J^T per square pixel, and the tilt's, from the camera's own functions.

    Of the tilt by finite differences: the robot turns about its origin, what is seen is held to be
    level.
    """
    camera = replace(published_camera, tangential=tangential)
    places = np.array(PLACES)
    fitted = np.random.default_rng(1).normal(0.0, 1e-3, (len(places), 2, 2))
    fitted = fitted @ fitted.swapaxes(-1, -2)
    jacobian = camera.floor_jacobian(camera.project_floor(places))
    step = 1e-5
    ends = [
        camera.floor_from_pixel(image_positions(camera, places, lean))
        for lean in ((step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step))
    ]
    tilt = np.stack([ends[0] - ends[1], ends[2] - ends[3]], axis=-1) / (2.0 * step)
    expected = fitted + 0.02**2 * jacobian @ jacobian.swapaxes(-1, -2)
    expected += np.radians(0.4) ** 2 * tilt @ tilt.swapaxes(-1, -2)
    found = refined_covariance(camera, places, fitted, 0.02, np.radians(0.4))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("place", "image_of"),
    [
        ((-0.6, -2.1), "noise"), ((0.4, -2.5), "saturated"), ((0.4, -2.5), "shaded"),
        ((0.8, -5.2), "noise"), ((-0.3, -3.6), "saturated"), ((-0.3, -3.6), "shaded"),
    ],
)  # fmt: skip
def test_fits_are_the_least_squares_of_the_reference(
    published_camera: Camera, table: VoteTable, place: tuple[float, float], image_of: str
) -> None:
    """The whole fit against SciPy's least squares of the plain model on the same pixels."""
    noise = 3.0
    image = PaintedFloor(published_camera, 60.0).disc(place, 210.0, 0.1, 0.7).image(noise)
    if image_of == "saturated":
        image = np.minimum(image, 150).astype(np.uint8)
    if image_of == "shaded":
        image = (image * np.linspace(0.5, 1.0, image.shape[1])).astype(np.uint8)
    u, v = nearest(published_camera, place)
    fit = fits_at(
        published_camera, image, table.floor_xy, np.array([[u, v]]), 0.1, noise, blur_ratio=0.5
    )
    assert fit.converged[0]
    candidate = Candidate(int(u), int(v), 0.1, BLUR_PX)
    flat = view_of(table.floor_xy, candidate, 1.0, 0.5).shape != EDGE
    assert flat == (place[1] < -3.0)
    rows, columns = np.divmod(
        pixels_within_reach(table.floor_xy, candidate, WHOLE.reach, 0.5), image.shape[1]
    )
    floor = table.floor_xy.astype(float) / 0.1
    x, y = (floor[rows, columns] - floor[v, u]).T
    by_u = (floor[rows, columns + 1] - floor[rows, columns - 1]).T / 2.0
    by_v = (floor[rows + 1, columns] - floor[rows - 1, columns]).T / 2.0
    down = np.linalg.norm(np.diff(floor[v - 1 : v + 2, u], axis=0), axis=-1)
    growth = 2.0 * (down[1] - down[0]) / down.sum()
    first, second = (by_v, by_u) if flat else (by_u, by_v)
    at = Pixels(x, y, first[0], first[1], second[0], second[1], growth)
    grey = image[rows, columns].astype(float)
    blurs = (0.5 * BLUR_PX, BLUR_PX) if flat else (BLUR_PX, 0.5 * BLUR_PX)
    usual = Expected(noise, RADIUS_SIGMA, blurs, BLUR_SIGMA)
    expected = fitted_disc(at, grey, flat, usual)
    sigma = np.sqrt(np.diag(fit.covariance[0])) / 0.1
    off = (fit.floor_xy[0] / 0.1 - floor[v, u]) - expected[:2]
    # Derivatives hold the curvature of the edge for constant, which costs a part of a deviation.
    assert np.all(np.abs(off) < 0.75 * sigma)
    assert fit.radius[0] / 0.1 == pytest.approx(expected[2], abs=2.0 * sigma.max())


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_nothing_is_fitted_where_there_is_nothing(
    published_camera: Camera, table: VoteTable, grey: int
) -> None:
    image = np.full(table.floor_xy.shape[:2], grey, np.uint8)
    pixels = np.array([[400, 200], [300, 120]])
    fit = fits_at(published_camera, image, table.floor_xy, pixels, 0.1, 0.5)
    assert not np.any(fit.converged & (fit.explained > 0.5))
