"""Compiled stages against what they compute, written out (`tests.reference.verticals`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import read_camera
from detect.line_settings import DEFAULT, PUBLISHED, LineSettings
from detect.projection import leaning_camera
from detect.sources.grey_images import decode_grey
from detect.verticals.refinement import Crossings, newton_step, step_filters
from detect.verticals.starts import LineStarts
from detect.verticals.tracking import LineTracks
from lut.verticals import VerticalTable, build_vertical_table
from tests.detect.line_scene import Edge, pinhole, render
from tests.detect.verticals.stages import judge_tracks, line_tracks, start_response
from tests.reference import verticals as reference
from tools.detector_maps import line_response

DEMO = Path(__file__).parents[3] / "images" / "e"
CAMERA = pinhole(200, 130, 150.0, pitch_deg=12.0, roll_deg=2.0, coef=(0.0, -0.1, 0.0, 0.0, 0.0))
TABLE = build_vertical_table(CAMERA)
#: A shorter filter of the published kind: that of the preset is as high as a third of the image.
SHORT = replace(PUBLISHED, sigma_along_rows=3.0, border_rows=6, least_rows=10)


def images() -> dict[str, NDArray[np.uint8]]:
    rng = np.random.default_rng(4)
    shape = (CAMERA.height, CAMERA.width)
    edges = [Edge(0.4, 60.0), Edge(0.2, -50.0), Edge(0.0, 80.0), Edge(-0.3, -40.0)]
    seen = render(leaning_camera(CAMERA, (0.02, -0.01)), edges, noise=2.0, rng=rng)
    return {
        "random": rng.integers(0, 256, shape).astype(np.uint8),
        "black": np.zeros(shape, np.uint8),
        "white": np.full(shape, 255, np.uint8),
        "saturated": np.clip(rng.normal(255.0, 60.0, shape), 0, 255).astype(np.uint8),
        "edges": seen,
        "saturated edges": np.where(seen > 120, 255, 0).astype(np.uint8),
    }


def assert_responses(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings = DEFAULT
) -> None:
    """Near the image's sides, windows that leave it count otherwise."""
    expected = reference.response(image, table, settings)
    found = line_response(image, table, settings)
    width = table.column.shape[1]
    with np.errstate(invalid="ignore"):
        inside = np.abs(table.column - 0.5 * (width - 1)) < 0.5 * width - 20.0
    inside |= ~np.isfinite(table.column)
    np.testing.assert_allclose(found[inside], expected[inside], atol=2e-4)
    assert np.mean(np.abs(found - expected) > 0.02) < 0.01
    # On the band round the horizon the window is laid over the strip: a few percent.
    band_response, band = start_response(image, table, settings)
    level, column = np.nonzero(band.row >= 0)
    off = np.abs(band_response[level, column] - expected[band.row[level, column], column])
    assert np.quantile(off, 0.99) <= 0.05


@pytest.mark.parametrize("settings", [DEFAULT, SHORT], ids=["default", "published"])
@pytest.mark.parametrize("kind", images())
def test_responses_are_those_of_the_reference(kind: str, settings: LineSettings) -> None:
    assert_responses(images()[kind], TABLE, settings)


@pytest.mark.parametrize("settings", [DEFAULT, SHORT], ids=["default", "published"])
@pytest.mark.parametrize("kind", ["random", "saturated", "edges", "saturated edges"])
def test_tracks_are_those_of_the_reference(kind: str, settings: LineSettings) -> None:
    image = images()[kind]
    response = line_response(image, TABLE, settings).astype(np.float64)
    rows = np.rint(np.where(TABLE.usable, TABLE.anchor_row, 0.0)).astype(np.intp)
    columns = np.arange(5, CAMERA.width - 5)
    score = np.abs(response[rows[columns], columns])
    peak = (score >= settings.threshold) & TABLE.usable[columns]
    peak[1:-1] &= (score[1:-1] > score[:-2]) & (score[1:-1] > score[2:])
    compared, both, off = 0, [], []
    for column in columns[peak][:20]:
        row = rows[column]
        start = LineStarts(
            first=np.array([0]),
            row=np.array([row]),
            column=np.array([column], np.float64),
            value=response[row, column : column + 1].astype(np.float32),
            below=np.array([-1]),
        )
        tracks = line_tracks(image, start, TABLE, replace(settings, guided=False))
        expected = reference.follow(response, int(row), int(column), settings)
        common, here, there = np.intersect1d(
            tracks.row, [v for v, _, _ in expected], return_indices=True
        )
        if len(common) < 10:
            continue
        compared += 1
        both.append(len(common) / max(len(tracks.row), len(expected)))
        off += np.abs(tracks.column[here] - np.array(expected)[there, 1]).tolist()
    # In noise the long filter has no maximum that is high enough.
    assert compared >= (3 if "edges" in kind else 0)
    # Three columns of the image, not of the strip, and along the edge, not along the vertical.
    if "edges" in kind:
        assert min(both) == 1.0
        assert np.median(off) <= 0.06
        assert np.quantile(off, 0.9) <= 0.3
        assert max(off) <= 0.55


def test_lines_through_tracks_are_those_of_the_reference() -> None:
    table = TABLE
    rng = np.random.default_rng(8)
    columns = np.arange(CAMERA.width)
    for middle in (40.0, 90.0, 150.0):
        row = np.arange(30, 100, dtype=np.int32)
        column = middle + 0.02 * (row - 60) + rng.normal(0.0, 0.2, len(row))
        bounds, score = np.array([0, len(row)]), np.ones(len(row), np.float32)
        tracks = LineTracks(np.ones(1), bounds, row, column, score)
        image = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
        fits = judge_tracks(image, tracks, table, DEFAULT, steps=0).fits
        bearing = np.interp(column, columns, table.bearing_rad)
        rise = [np.interp(c, columns, table.elevation_tan[v]) for v, c in zip(row, column)]
        expected = reference.eigenline(bearing, np.array(rise), float(fits.reference_rad[0]))
        np.testing.assert_allclose(fits.line[0], expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("step", [0, 1, 3])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_steps_of_the_refinement_are_those_of_the_reference(step: int, sign: float) -> None:
    edge = Edge(0.0, 80.0 * sign)
    grey = 80.0 if sign > 0.0 else 200.0
    image = render(CAMERA, [edge], grey=grey, noise=2.0, rng=np.random.default_rng(9))
    filters = step_filters(DEFAULT)
    sigma, _ = DEFAULT.refine_steps_px[step]
    half = int(filters.half[step])
    row = np.arange(20, 110, dtype=np.int32)
    nearest = int(np.nanargmin(np.abs(TABLE.bearing_rad)))
    at = TABLE.column[row, nearest].astype(np.float64) + 0.3
    at[[5, 17]] = np.nan
    by = np.stack([np.full(len(row), 150.0), 150.0 * (row - 65.0) / 150.0], axis=1)
    crossings = Crossings(row, at, by[:, 0].copy(), by[:, 1].copy())
    found = newton_step(image, crossings, filters.weights[step], half, sign)
    change, covariance = reference.newton_step(image, row, at, by, sigma, half, sign)
    # In pixels: weights are tabulated at 64 positions in a pixel, and straight between them.
    moved = by @ np.array([found.change_a, found.change_b])
    np.testing.assert_allclose(moved, by @ change, rtol=5e-3, atol=5e-3)
    expected = covariance[[0, 0, 1], [0, 1, 1]]
    off = np.abs(np.array([found.aa, found.ab, found.bb]) - expected)
    assert off.max() <= 0.02 * np.trace(covariance)


@pytest.mark.parametrize("number", [3, 40])
def test_responses_to_frames_of_the_demo_run_are_those_of_the_reference(number: int) -> None:
    table = build_vertical_table(read_camera(DEMO / "e.cam"))
    image = decode_grey((DEMO / "images" / f"e.{number:04d}.jpg").read_bytes(), number)
    assert_responses(image, table)
