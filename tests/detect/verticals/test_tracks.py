"""The response of the filter, its maxima on the horizon, and tracking over gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from detect.line_settings import DEFAULT, PUBLISHED, LineSettings
from detect.verticals import starts
from detect.verticals.response import line_response, weights_across
from detect.verticals.starts import find_maxima, start_band
from detect.verticals.tilt import TiltEstimate
from lut.verticals import build_vertical_table
from tests.detect.line_scene import Edge, pinhole, render, tilted
from tests.detect.verticals.stages import line_starts, line_tracks, response_to, start_response

CAMERA = pinhole(96, 64, 110.0)
TABLE = build_vertical_table(CAMERA)


def step_image(left: int, right: int, column: int = 48) -> np.ndarray:
    image = np.full((64, 96), left, np.uint8)
    image[:, column:] = right
    return image


@given(hnp.arrays(np.uint8, (64, 96)))
@settings(max_examples=10, deadline=None)
def test_response_is_a_squared_correlation(image: np.ndarray) -> None:
    for preset in (DEFAULT, PUBLISHED):
        response = line_response(image, TABLE, replace(preset, regulariser=1e-3))
        assert np.abs(response).max() <= 1.0 + 1e-4


def test_response_is_the_squared_correlation_of_the_window() -> None:
    """Against its definition, evaluated directly where strip and image are the same."""
    image = np.random.default_rng(0).integers(0, 256, (64, 96)).astype(np.uint8)
    across, along = weights_across(0.8)[0], weights_across(2.0)[0]
    weight = along[:, None] * across[None, :]
    response = line_response(image, TABLE, DEFAULT)
    distance = np.broadcast_to(np.arange(-3.0, 4.0), weight.shape)
    distance = distance / np.sqrt(np.sum(weight * distance**2))
    for v in (8, 30, 55):
        for c in (10, 47, 80):
            window = image[v - 6 : v + 7, c - 3 : c + 4].astype(np.float64)
            covariance = np.sum(weight * distance * window)
            variance = np.sum(weight * window**2) - np.sum(weight * window) ** 2
            expected = covariance * abs(covariance) / (variance + DEFAULT.regulariser)
            assert response[v, c] == pytest.approx(expected, abs=2e-5)


def test_ideal_step_reaches_two_over_pi() -> None:
    wide = replace(DEFAULT, sigma_across_px=2.5, sigma_along_rows=7.0, regulariser=1e-3)
    rising = line_response(step_image(50, 180), TABLE, wide)
    falling = line_response(step_image(180, 50), TABLE, wide)
    # The step lies between two columns.
    assert rising[32, 47:49].max() == pytest.approx(2.0 / np.pi, abs=0.02)
    np.testing.assert_allclose(falling, -rising, atol=1e-4)


@given(gain=st.sampled_from([1, 2, 3]), offset=st.integers(0, 60))
@settings(max_examples=10, deadline=None)
def test_affine_brightness_changes_only_what_the_regulariser_adds(gain: int, offset: int) -> None:
    image = np.random.default_rng(1).integers(0, 60, (64, 96)).astype(np.uint8)
    bright = (gain * image.astype(int) + offset).astype(np.uint8)
    first = line_response(image, TABLE, DEFAULT)
    second = line_response(bright, TABLE, replace(DEFAULT, regulariser=40.0 * gain**2))
    np.testing.assert_allclose(second, first, atol=1e-4)


def test_filter_goes_up_to_where_the_verticals_end() -> None:
    """Windows are cut off at the border, not the image: a step is as good there as elsewhere."""
    response = line_response(step_image(50, 180), TABLE, DEFAULT)
    # In the middle of the image, where verticals are columns.
    np.testing.assert_allclose(response[:, 48], response[32, 48], atol=1e-4)


def test_starts_lie_on_the_horizon_band_highest_first() -> None:
    image = render(CAMERA, [Edge(0.2, 40.0), Edge(-0.1, 90.0)], grey=60.0)
    on_horizon = line_starts(image, TABLE, replace(DEFAULT, start_band_rows=0))
    np.testing.assert_array_equal(
        on_horizon.row, np.rint(TABLE.anchor_row[on_horizon.column]).astype(int)
    )
    assert len(on_horizon.row) == 2
    band = line_starts(image, TABLE, replace(DEFAULT, start_band_rows=8))
    assert set(np.unique(band.row - np.rint(TABLE.anchor_row[band.column]))) == {-8, -4, 0, 4, 8}
    assert np.all(np.diff(np.abs(band.value)) <= 0.0)
    assert np.all(np.abs(band.value) >= DEFAULT.threshold)


def test_starts_are_on_chains() -> None:
    """What is left out has no maximum of its sign above or below; the columns of an edge have."""
    rng = np.random.default_rng(6)
    image = render(CAMERA, [Edge(0.2, 40.0), Edge(-0.1, 90.0)], grey=60.0, noise=12.0, rng=rng)
    response, band = start_response(image, TABLE, DEFAULT)
    assert band.chained
    maxima = find_maxima(response, DEFAULT.threshold)
    every = starts.line_starts(maxima, band._replace(chained=False))
    found = starts.line_starts(maxima, band)
    assert 10 < len(found.row) <= len(every.row) - 4
    places = set(zip(found.row.tolist(), found.column.tolist()))
    above_or_below = np.abs(maxima.level[:, None] - maxima.level) == 1
    near = above_or_below & (np.abs(maxima.place[:, None] - maxima.place) < 1.5)
    near &= maxima.value[:, None] * maxima.value > 0.0
    for k in range(len(maxima.level)):
        place = int(band.row[maxima.level[k], maxima.column[k]]), int(maxima.column[k])
        if place in places:
            assert near[k].any()
    for edge in (0.2, -0.1):
        at = 47.5 - 110.0 * np.tan(edge)
        assert np.sum(np.abs(found.column - at) < 1.6) >= 3


@pytest.mark.parametrize("spacing", [1, 4, 8])
def test_starts_need_chains_only_where_lines_cross_several_rows(spacing: int) -> None:
    settings = replace(DEFAULT, start_spacing_rows=spacing, least_length_px=0.0, least_rows=14)
    assert start_band(TABLE, settings).chained == (spacing < 8)
    assert not start_band(TABLE, PUBLISHED).chained


@pytest.mark.parametrize("gap", [5, 25])
def test_tracks_bridge_gaps_up_to_a_length(gap: int) -> None:
    image = step_image(60, 160)
    below = int(TABLE.anchor_row[48]) + 6
    # A bright block hides the edge; the filter sees it from a few rows away.
    image[below : below + gap] = 110
    starts = line_starts(image, TABLE, replace(DEFAULT, start_band_rows=0))
    tracks = line_tracks(image, starts, TABLE, DEFAULT)
    assert len(tracks.polarity) == 1
    assert tracks.top_row[0] == DEFAULT.border_rows
    if gap == 5:
        assert tracks.bottom_row[0] == 63 - DEFAULT.border_rows
    else:
        assert tracks.bottom_row[0] < below + 3


def test_tracks_know_polarity_and_follow_subpixel() -> None:
    camera = tilted(CAMERA, 0.0, np.radians(4.0))
    image = render(camera, [Edge(0.1, 80.0), Edge(-0.15, -60.0)], grey=100.0)
    tracks = line_tracks(image, line_starts(image, TABLE, DEFAULT), TABLE, DEFAULT)
    assert sorted(tracks.polarity) == [-1.0, 1.0]
    for t in range(2):
        part = slice(tracks.bounds[t], tracks.bounds[t + 1])
        rows, columns = tracks.row[part], tracks.column[part]
        np.testing.assert_array_equal(rows, np.arange(rows[0], rows[-1] + 1))
        line = np.polyfit(rows, columns, 1)
        # tan 4 deg, in the strip of the untilted camera.
        assert abs(line[0]) == pytest.approx(np.tan(np.radians(4.0)), rel=0.05)
        assert np.abs(columns - np.polyval(line, rows)).max() < 0.12


def test_guided_tracks_leave_edges_that_lean_otherwise() -> None:
    leaning = render(tilted(CAMERA, 0.0, np.radians(5.0)), [Edge(0.0, 90.0)])
    starts = line_starts(leaning, TABLE, replace(DEFAULT, start_band_rows=0))
    none, right = (TiltEstimate(0.0, np.radians(roll), np.eye(2), 3) for roll in (0.0, 5.0))
    assert line_tracks(leaning, starts, TABLE, DEFAULT).points[0] == 60
    assert line_tracks(leaning, starts, TABLE, DEFAULT, right).points[0] == 60
    assert line_tracks(leaning, starts, TABLE, DEFAULT, none).points[0] < 45


def test_no_horizon_no_tracks() -> None:
    table = build_vertical_table(pinhole(96, 64, 110.0, pitch_deg=70.0))
    image = step_image(50, 180)
    response = line_response(image, table, DEFAULT)
    assert not response.any()
    tracks = line_tracks(image, line_starts(image, table, DEFAULT), table, DEFAULT)
    assert len(tracks.polarity) == 0


# -- evaluated only where needed: against the filter evaluated everywhere -------------------------


@pytest.mark.parametrize("preset", [DEFAULT, PUBLISHED], ids=["default", "published"])
@pytest.mark.parametrize("tilt_deg", [0.0, 4.0, -9.0])
def test_tracks_see_the_same_response_as_the_whole_strip(
    preset: LineSettings, tilt_deg: float
) -> None:
    camera = pinhole(160, 120, 150.0, pitch_deg=15.0, roll_deg=0.5 * tilt_deg)
    table = build_vertical_table(camera)
    preset = replace(preset, border_rows=2, threshold=min(preset.threshold, 0.2))
    edges = [Edge(0.3, 60.0), Edge(0.1, -80.0), Edge(-0.2, 50.0)]
    seen = tilted(camera, 0.0, np.radians(tilt_deg))
    image = render(seen, edges, noise=4.0, rng=np.random.default_rng(1))
    response = line_response(image, table, preset)
    tracks = line_tracks(image, line_starts(image, table, preset), table, preset)
    assert tracks.points.sum() > 100
    for t in range(len(tracks.polarity)):
        part = slice(tracks.bounds[t], tracks.bounds[t + 1])
        column = np.rint(tracks.column[part]).astype(int)
        signed = (
            tracks.polarity[t] * response[tracks.row[part][:, None], column[:, None] + [-1, 0, 1]]
        )
        np.testing.assert_allclose(signed.max(axis=1), tracks.score[part], atol=2e-4)


def test_tracks_see_the_same_response_at_the_borders() -> None:
    """Where windows are cut off, verticals leave the image, or there are none beside them."""
    camera = pinhole(160, 120, 90.0, pitch_deg=35.0, roll_deg=20.0)
    table = build_vertical_table(camera)
    assert not table.usable.all()
    edges = [Edge(bearing, 70.0 * (-1.0) ** k) for k, bearing in enumerate(np.linspace(-1, 1, 25))]
    image = render(camera, edges, grey=120.0, noise=2.0, rng=np.random.default_rng(2))
    for preset in (DEFAULT, PUBLISHED):
        preset = replace(preset, border_rows=0, threshold=0.1)
        response = line_response(image, table, preset)
        tracks = line_tracks(image, line_starts(image, table, preset), table, preset)
        assert tracks.points.sum() > 500
        polarity = np.repeat(tracks.polarity, tracks.points)
        column = np.rint(tracks.column).astype(int)
        around = response[tracks.row[:, None], column[:, None] + [-1, 0, 1]]
        highest = (polarity[:, None] * around).max(axis=1)
        np.testing.assert_allclose(highest, tracks.score, atol=2e-4)


def test_what_was_filtered_before_gives_the_same_tracks() -> None:
    image = render(CAMERA, [Edge(0.1, 80.0), Edge(-0.15, -60.0)], grey=100.0)
    starts = line_starts(image, TABLE, DEFAULT)
    response = response_to(image, TABLE, DEFAULT)
    tilt = TiltEstimate(0.01, -0.02, np.eye(2), 3)
    fresh = line_tracks(image, starts, TABLE, DEFAULT, tilt)
    line_tracks(response, starts, TABLE, DEFAULT)
    again = line_tracks(response, starts, TABLE, DEFAULT, tilt)
    for name in ("row", "column", "score", "bounds", "polarity"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fresh, name))


@pytest.mark.parametrize("preset", [DEFAULT, PUBLISHED], ids=["default", "published"])
def test_response_of_the_starts_is_that_of_the_whole_strip(preset: LineSettings) -> None:
    """Exactly where the strip's columns are a pixel wide, nearly elsewhere."""
    rng = np.random.default_rng(4)
    edges = [
        Edge(bearing, rng.choice([-70.0, 40.0, 90.0])) for bearing in np.linspace(-0.4, 0.4, 9)
    ]
    for pitch, limit in ((0.0, 2e-3), (20.0, 0.08)):
        camera = pinhole(240, 160, 200.0, pitch_deg=pitch)
        table = build_vertical_table(camera)
        image = render(camera, edges, grey=120.0, noise=2.0, rng=rng)
        whole = line_response(image, table, preset)
        response, band = start_response(image, table, preset)
        k, c = np.nonzero(band.row >= 0)
        np.testing.assert_allclose(response[k, c], whole[band.row[k, c], c], atol=limit)
        # The published border leaves no row of the camera that looks down.
        assert len(k) == 0 or np.abs(response).max() > 0.4
