"""Discs and verticals through lenses with Brown's terms, as exactly as through another."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from camera import Camera
from detect.circles import detect_circles, disc_table
from detect.lines import detect_lines
from detect.markers.geometry import picture_of
from detect.projection import leaning_camera
from detect.settings import CircleSettings
from lut import build_vertical_table
from tests.detect.line_scene import EDGES, edge_columns, pinhole, render, tilt_of
from tests.detect.painted_floor import PaintedFloor

TANGENTIAL = (2e-3, -3e-3)
#: EuRoC's cam0: its lens alone, and a decentred one like it.
EUROC = (-0.28340811, 0.07395907, 0.0)
PLACES = np.array([[0.0, -1.3], [1.2, -2.4], [-1.1, -1.9], [0.45, -3.6], [-0.9, -4.4]])


@pytest.fixture(scope="module")
def decentred(published_camera: Camera) -> Camera:
    return replace(published_camera, tangential=TANGENTIAL)


def largest_error_m(seen_by: Camera, believed: Camera) -> float:
    """Of the discs' places, each found once."""
    floor = PaintedFloor(seen_by)
    for place in PLACES:
        floor.disc(place)
    settings = CircleSettings(polarity="light")
    table = disc_table(believed, settings)
    found = detect_circles(floor.image(), believed, table, settings)
    assert len(found) == len(PLACES)
    distance = np.linalg.norm(found.floor_xy[:, None] - PLACES, axis=-1)
    assert sorted(distance.argmin(axis=1)) == list(range(len(PLACES)))
    return float(distance.min(axis=1).max())


def test_discs_are_found_as_exactly_as_through_a_radial_lens(
    published_camera: Camera, decentred: Camera
) -> None:
    radial = largest_error_m(published_camera, published_camera)
    assert radial < 0.002
    assert largest_error_m(decentred, decentred) < 1.5 * radial
    # Without the terms positions are wrong: the scene does test them.
    assert largest_error_m(decentred, published_camera) > 10.0 * radial


def test_discs_are_found_as_exactly_through_a_plumb_bob(published_camera: Camera) -> None:
    plumb_bob = replace(published_camera, coef=(0.0,) * 5, polynomial=EUROC, tangential=TANGENTIAL)
    assert largest_error_m(plumb_bob, plumb_bob) < 0.002
    assert largest_error_m(plumb_bob, published_camera) > 0.01


@pytest.mark.parametrize(
    "lens", [{"tangential": TANGENTIAL}, {"coef": (0.0,) * 5, "polynomial": EUROC}]
)
def test_verticals_are_found_as_exactly_as_through_a_radial_lens(lens: dict[str, Any]) -> None:
    radial = pinhole(240, 160, 200.0, pitch_deg=10.0, roll_deg=1.0, coef=(0.0, -0.1, 0.0, 0.0, 0.0))
    bent = replace(radial, **lens)
    truth = np.array([edge.bearing_rad for edge in EDGES])
    turn = (math.radians(2.3), math.radians(-1.0))
    errors = []
    for seen_by, believed in ((radial, radial), (bent, bent), (bent, radial)):
        rng = np.random.default_rng(0)
        image = render(leaning_camera(seen_by, turn), EDGES, noise=2.0, rng=rng)
        found = detect_lines(image, build_vertical_table(believed))
        assert len(found.lines.alpha_rad) == len(EDGES)
        off = np.degrees(np.abs(tilt_of(found) - turn).max())
        errors.append((np.abs(found.lines.alpha_rad - truth).max(), off))
        if believed is bent:
            # Ends are undistorted: through the lens they lie on the edges.
            ends = np.array([[r.xtop, r.ytop, r.xbottom, r.ybottom] for r in found.landmarks()])
            pixels = bent.distort(ends.reshape(-1, 2, 2))
            for (top, bottom), bearing in zip(pixels, truth):
                rows = np.array([top[1], bottom[1]])
                columns = edge_columns(leaning_camera(bent, turn), bearing, rows)
                np.testing.assert_allclose([top[0], bottom[0]], columns, atol=0.3)
    assert errors[0][0] < 4e-4
    assert errors[1][0] < 4e-4
    assert errors[0][1] < 0.08
    assert errors[1][1] < 0.08
    assert errors[2][0] > 6e-4


def test_straight_pixels_of_markers(decentred: Camera) -> None:
    image = np.zeros((decentred.height, decentred.width), np.uint8)
    pixels = np.random.default_rng(4).uniform([1, 1], [766, 286], size=(200, 2))
    scale = np.array([decentred.scale_x, decentred.scale_y])
    expected = decentred.undistort(pixels) * scale + np.array([384.0, 144.0])
    np.testing.assert_allclose(picture_of(image, decentred).undistort(pixels), expected, atol=0.005)
    # Tangential terms alone make a lens, too.
    alone = replace(decentred, coef=(0.0,) * 5)
    assert not np.allclose(picture_of(image, alone).undistort(pixels), pixels, atol=0.01)
    # And so does a polynomial.
    plumb_bob = replace(alone, tangential=(0.0, 0.0), polynomial=EUROC)
    expected = plumb_bob.undistort(pixels) * scale + np.array([384.0, 144.0])
    np.testing.assert_allclose(picture_of(image, plumb_bob).undistort(pixels), expected, atol=0.01)
