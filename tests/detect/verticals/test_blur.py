"""Images whose edges are all blurred: how much is found out, and verticals are found again."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from detect.line_settings import DEFAULT, PUBLISHED
from detect.lines import blur_of_sharpness, detect_lines, median_sharpness, widened, width_for
from detect.projection import leaning_camera
from detect.verticals.refinement import LineFits
from lut.verticals import build_vertical_table
from tests.detect.line_scene import Edge, pinhole, render

CAMERA = pinhole(480, 240, 400.0, pitch_deg=8.0)
TABLE = build_vertical_table(CAMERA)
BEARINGS = np.linspace(0.44, -0.44, 7)
EDGES = [Edge(float(b), 55.0 if k % 2 else -55.0) for k, b in enumerate(BEARINGS)]
NEVER_WIDER = replace(DEFAULT, blurred_widths=())


def seen(turned_px: int = 1, blur_px: float = 0.6, noise: float = 2.0) -> NDArray[np.uint8]:
    """The edges, seen by a robot that tilts and, while the shutter is open, turns."""
    leaning = leaning_camera(CAMERA, (0.01, -0.006))
    sharp = render(leaning, EDGES, blur_px=blur_px).astype(np.float64)
    ramp = cv2.blur(sharp, (turned_px, 1)) if turned_px > 1 else sharp
    ramp += np.random.default_rng(5).normal(0.0, noise, ramp.shape)
    return np.asarray(np.clip(np.rint(ramp), 0, 255), np.uint8)


@given(blur=st.floats(0.1, 8.0), fine=st.floats(0.5, 2.0), ratio=st.floats(1.5, 4.0))
def test_sharpness_tells_the_blur(blur: float, fine: float, ratio: float) -> None:
    coarse = ratio * fine

    def contrast(width: float) -> float:
        return width / math.hypot(width, blur)

    told = blur_of_sharpness(contrast(fine) / contrast(coarse), fine, coarse)
    assert told == pytest.approx(blur, rel=1e-4)


def test_sharpness_beyond_its_bounds() -> None:
    assert blur_of_sharpness(1.0, 0.8, 1.6) == 0.0
    assert math.isinf(blur_of_sharpness(0.5, 0.8, 1.6))
    assert math.isinf(blur_of_sharpness(0.2, 0.8, 1.6))


def fits(contrast: NDArray[np.float64], sharpness: NDArray[np.float64]) -> LineFits:
    one, two = np.ones(len(contrast)), np.ones((len(contrast), 2))
    four = np.ones((len(contrast), 2, 2))
    return LineFits(one, one, two, four, one, one, one, contrast, sharpness)


def test_the_median_is_that_of_the_edges_that_were_refined() -> None:
    rng = np.random.default_rng(3)
    for count, missing in [(7, 2), (8, 0), (12, 5), (5, 2)]:
        contrast, sharpness = rng.random((2, count))
        contrast[rng.permutation(count)[:missing]] = np.nan
        told = np.sort(sharpness[np.isfinite(contrast)])
        assert median_sharpness(fits(contrast, sharpness)) == told[(len(told) - 1) // 2]
    contrast[2:] = np.nan
    assert median_sharpness(fits(contrast, sharpness)) == 1.0
    assert median_sharpness(fits(np.empty(0), np.empty(0))) == 1.0


def test_filters_become_as_wide_as_the_blur() -> None:
    widths = DEFAULT.blurred_widths
    told = [width_for(sharpness, DEFAULT) for sharpness in (0.619, 0.6, 0.56, 0.53, 0.51, 0.4)]
    assert told == sorted(told)
    assert (told[0], told[-1]) == (widths[0], widths[-1])
    wider = widened(DEFAULT, 2.0)
    assert wider.blurred_widths == (1.5, 2.0, 3.0)
    assert wider.sigma_across_px == 2.0 * DEFAULT.sigma_across_px
    assert wider.refine_steps_px == tuple((2.0 * a, 2.0 * b) for a, b in DEFAULT.refine_steps_px)
    # What is no length across an edge stays as it is.
    changed = {f.name for f in fields(wider) if getattr(wider, f.name) != getattr(DEFAULT, f.name)}
    assert not changed & {"sigma_along_rows", "least_length_px", "threshold", "join_share"}
    assert widened(DEFAULT, widths[-1]).blurred_widths == ()
    assert PUBLISHED.blurred_widths == ()


def test_filters_become_no_wider_than_allowed() -> None:
    wide = replace(DEFAULT, sigma_across_px=20.0, fine_scale_px=20.0, coarse_scale_px=40.0)
    assert widened(wide, 6.0).coarse_scale_px == 100.0
    assert widened(wide, 6.0).fine_scale_px == 50.0
    assert widened(wide, 3.0).blurred_widths == ()
    assert widened(replace(DEFAULT, coarse_scale_px=16.96), 6.0).coarse_scale_px == 100.0


@pytest.mark.parametrize(("turned_px", "blur_px"), [(9, 0.6), (15, 0.6), (1, 3.0), (1, 6.0)])
def test_blurred_edges_are_where_sharp_ones_are(turned_px: int, blur_px: float) -> None:
    image = seen(turned_px, blur_px)
    found = detect_lines(image, TABLE)
    assert len(found) == len(EDGES)
    error = found.lines.alpha_rad - BEARINGS
    np.testing.assert_allclose(error, 0.0, atol=1.5e-3)
    assert np.mean((error / found.lines.sigma_rad) ** 2) < 1.5
    assert found.tilt is not None
    off = np.array([found.tilt.pitch_rad - 0.01, found.tilt.roll_rad + 0.006])
    assert np.abs(off).max() < np.radians(0.3)
    assert off @ np.linalg.solve(found.tilt.covariance, off) < 13.8
    # As narrow as it is set, the filter finds less of them, or finds them elsewhere.
    before = detect_lines(image, TABLE, NEVER_WIDER)
    worst = np.abs(before.lines.alpha_rad[:, None] - BEARINGS).min(axis=1).max(initial=0.0)
    assert len(before) < len(EDGES) or worst > 2.0 * np.abs(error).max()


def test_sharp_images_are_looked_at_once() -> None:
    image = seen()
    found = detect_lines(image, TABLE)
    assert len(found) == len(EDGES)
    assert median_sharpness(found.judged.fits) > DEFAULT.blurred_sharpness
    again = detect_lines(image, TABLE, NEVER_WIDER)
    np.testing.assert_equal(found.lines, again.lines)
    np.testing.assert_array_equal(found.tracks.column, again.tracks.column)
