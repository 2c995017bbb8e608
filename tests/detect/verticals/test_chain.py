"""The tilt from the band round the horizon alone; starts in order."""

from __future__ import annotations

import numpy as np
import pytest

from camera import Camera
from detect.line_settings import DEFAULT, LineNumbers
from detect.lines import detect_lines
from detect.verticals.judgement import tilt_of_chains
from detect.verticals.response import strip_of
from detect.verticals.starts import find_maxima
from detect.verticals.tilt import TiltEstimate
from lut.verticals import build_vertical_table
from tests.detect.line_scene import Edge, pinhole, render, tilted
from tests.detect.verticals.stages import start_response

CAMERA = pinhole(320, 160, 200.0, pitch_deg=10.0, roll_deg=1.0, row_aspect=2.0)
TABLE = build_vertical_table(CAMERA)


def edges(count: int) -> list[Edge]:
    bearings = np.linspace(-0.6, 0.6, count)
    return [Edge(bearing, 80.0 * (-1.0) ** k) for k, bearing in enumerate(bearings)]


def scene(camera: Camera, count: int) -> np.ndarray:
    return render(camera, edges(count), noise=1.0, rng=np.random.default_rng(count))


def told_by_the_band(image: np.ndarray) -> TiltEstimate | None:
    response, band = start_response(image, TABLE, DEFAULT)
    maxima = find_maxima(response, DEFAULT.threshold)
    numbers = LineNumbers.of(DEFAULT, TABLE.row_aspect)
    return tilt_of_chains(strip_of(TABLE), maxima, band, numbers)


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (2.3, 0.5), (-1.5, 2.0), (3.5, -3.0)])
def test_the_band_tells_the_tilt_of_a_camera(tilt_deg: tuple[float, float]) -> None:
    pitch, roll = np.radians(tilt_deg)
    tilt = told_by_the_band(scene(tilted(CAMERA, pitch, roll), 16))
    assert tilt is not None
    assert tilt.lines >= 14
    np.testing.assert_allclose(np.degrees([tilt.pitch_rad, tilt.roll_rad]), tilt_deg, atol=0.35)


@pytest.mark.parametrize("count", [0, 2])
def test_a_band_with_hardly_an_edge_tells_none(count: int) -> None:
    assert told_by_the_band(scene(CAMERA, count)) is None


def test_lines_are_those_that_all_edges_tell() -> None:
    """The way by the band, and the way by all edges, end at the same lines."""
    image = scene(tilted(CAMERA, 0.03, -0.02), 16)
    by_band, by_all = (
        detect_lines(image, TABLE, DEFAULT),
        detect_lines(image, TABLE, type(DEFAULT)(first_edges=0)),
    )
    assert len(by_band) == len(by_all) == 16
    np.testing.assert_allclose(by_band.alpha_rad, by_all.alpha_rad, atol=2e-5)


def test_chains_go_on_with_the_nearest_maximum_of_their_sign() -> None:
    response = np.zeros((3, 40), np.float32)
    for k, row in enumerate([{10: 0.5, 20: -0.5}, {9: -0.5, 11: 0.5, 23: -0.5}, {12: 0.5}]):
        for c, value in row.items():
            response[k, c - 1 : c + 2] = value * np.array([0.2, 1.0, 0.2], np.float32)
    maxima = find_maxima(response, 0.1)
    np.testing.assert_array_equal(maxima.column, [10, 20, 9, 11, 23, 12])
    np.testing.assert_array_equal(np.sign(maxima.value), [1.0, -1.0, -1.0, 1.0, -1.0, 1.0])
    np.testing.assert_allclose(maxima.place[[0, 1, 4, 5]], [10.0, 20.0, 23.0, 12.0], atol=0.3)
    np.testing.assert_array_equal(maxima.chain, [0, 1, 2, 0, 4, 0])
