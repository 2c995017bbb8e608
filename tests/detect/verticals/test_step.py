"""One rendered step: where the detector puts it, and how far its own uncertainty can be trusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from camera import Camera
from detect.line_settings import DEFAULT
from detect.lines import LineDetections, detect_lines
from lut.verticals import VerticalTable, build_vertical_table
from tests.detect.line_scene import Edge, pinhole, render

#: Weak edges must be found to be judged.
SETTINGS = replace(DEFAULT, least_evidence=1.0, largest_noise_px=np.inf)
PERIOD = np.arange(16) / 16.0


def only_line(
    image: np.ndarray, table: VerticalTable, bearing_rad: float
) -> tuple[LineDetections, float, float]:
    """Detection, its error and its predicted standard deviation due to noise, in pixels."""
    found = detect_lines(image, table, SETTINGS)
    assert len(found) == 1
    pixel = found.judged.fits.pixel_rad[found.lines.members[0]]
    noise_px = np.sqrt((found.lines.sigma_rad[0] / pixel) ** 2 - SETTINGS.sigma_px**2)
    return found, (found.lines.alpha_rad[0] - bearing_rad) / pixel, noise_px


def bearing_at(camera: Camera, table: VerticalTable, offset_px: float) -> float:
    column = 0.5 * camera.width + offset_px
    return float(np.interp(column, np.arange(camera.width), table.bearing_rad))


@pytest.mark.parametrize("slant_deg", [0.0, 2.0, -9.0, 20.0, -20.0])
@pytest.mark.parametrize(("contrast", "blur_px"), [(200.0, 0.2), (-200.0, 0.6), (60.0, 1.2)])
def test_no_bias_over_a_period_of_subpixel_offsets(
    slant_deg: float, contrast: float, blur_px: float
) -> None:
    camera = pinhole(120, 90, roll_deg=slant_deg)
    table = build_vertical_table(camera)
    # A little noise: quantisation alone would hide where an edge along whole columns is.
    rng = np.random.default_rng(3)
    errors = []
    for offset in PERIOD:
        bearing = bearing_at(camera, table, offset)
        image = render(
            camera,
            [Edge(bearing, contrast)],
            grey=30.0 if contrast > 0 else 230.0,
            blur_px=blur_px,
            noise=0.5,
            rng=rng,
        )
        errors.append(only_line(image, table, bearing)[1])
    assert np.abs(errors).max() < 0.02


@pytest.mark.parametrize("slant_deg", [0.0, 20.0])
def test_no_bias_of_faint_edges_under_noise(slant_deg: float) -> None:
    rng = np.random.default_rng(11)
    camera = pinhole(120, 90, roll_deg=slant_deg)
    table = build_vertical_table(camera)
    errors = []
    for offset in np.repeat(PERIOD, 8):
        bearing = bearing_at(camera, table, offset)
        image = render(camera, [Edge(bearing, 10.0)], noise=0.7, rng=rng)
        errors.append(only_line(image, table, bearing)[1])
    by_offset = np.mean(np.reshape(errors, (len(PERIOD), -1)), axis=1)
    assert np.abs(by_offset).max() < 0.02


@pytest.mark.long
@pytest.mark.parametrize(
    ("contrast", "noise", "slant_deg"),
    [(10.0, 1.0, 0.0), (30.0, 3.0, 7.0), (60.0, 3.0, -20.0), (200.0, 4.0, 20.0)],
)
def test_scatter_under_noise_is_the_predicted_one(
    contrast: float, noise: float, slant_deg: float
) -> None:
    rng = np.random.default_rng(17)
    camera = pinhole(120, 90, roll_deg=slant_deg)
    table = build_vertical_table(camera)
    errors, predicted, leans = [], [], []
    for offset in rng.uniform(0.0, 1.0, 120):
        bearing = bearing_at(camera, table, offset)
        grey = 128.0 - 0.5 * contrast
        image = render(camera, [Edge(bearing, contrast)], grey=grey, noise=noise, rng=rng)
        found, error, sigma = only_line(image, table, bearing)
        errors.append(error)
        predicted.append(sigma)
        track = found.lines.members[0]
        leans.append(
            found.judged.fits.line[track, 1] / np.sqrt(found.judged.fits.covariance[track, 1, 1])
        )
    # 120 draws know a standard deviation to 6.5 %.
    assert np.std(errors) == pytest.approx(np.sqrt(np.mean(np.square(predicted))), rel=0.2)
    assert abs(np.mean(errors)) < 0.02
    assert np.std(leans) == pytest.approx(1.0, rel=0.25)


def test_uncertainty_of_a_row_has_a_floor_of_sigma_px() -> None:
    camera = pinhole(120, 90)
    table = build_vertical_table(camera)
    found, _, noise_px = only_line(render(camera, [Edge(0.01, 150.0)]), table, 0.01)
    track = found.lines.members[0]
    pixel, covariance = found.judged.fits.pixel_rad[track], found.judged.fits.covariance[track]
    assert found.lines.sigma_rad[0] >= DEFAULT.sigma_px * pixel
    # The known lean of verticals makes a bearing more certain than the track's own.
    assert 0.0 < noise_px <= np.sqrt(covariance[0, 0]) / pixel + 1e-9
    assert noise_px < 0.05


def test_neighbouring_edges_do_not_push_each_other() -> None:
    """A bar of 5 pixels: what the wide filters see of its other side is left out."""
    camera = pinhole(160, 90)
    table = build_vertical_table(camera)
    left, right = bearing_at(camera, table, 0.3), bearing_at(camera, table, 5.3)
    image = render(camera, [Edge(left, 100.0), Edge(right, -100.0)], grey=80.0)
    found = detect_lines(image, table)
    np.testing.assert_allclose(
        found.lines.alpha_rad, [left, right], atol=0.1 * found.judged.fits.pixel_rad[0]
    )
