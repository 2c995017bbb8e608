"""The response of the filter, its maxima on the horizon, and tracking over gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra import numpy as hnp

from detect.line_settings import DEFAULT, PUBLISHED, LineSettings
from detect.projection import leaning_camera
from detect.verticals import starts
from detect.verticals.starts import LineStarts, start_band
from detect.verticals.tracking import LineTracks
from lut.verticals import build_vertical_table
from tests.detect.line_scene import Edge, pinhole, render
from tests.detect.verticals.stages import (
    last_rows,
    line_starts,
    line_tracks,
    start_response,
    tracks_again,
)
from tools.detector_maps import line_response

CAMERA = pinhole(96, 64, 110.0)
TABLE = build_vertical_table(CAMERA)


def step_image(left: int, right: int, column: int = 48) -> np.ndarray:
    image = np.full((64, 96), left, np.uint8)
    image[:, column:] = right
    return image


@given(hnp.arrays(np.uint8, (64, 96)))
@settings(max_examples=10)
def test_response_is_a_squared_correlation(image: np.ndarray) -> None:
    for preset in (DEFAULT, PUBLISHED):
        response = line_response(image, TABLE, replace(preset, regulariser=1e-3))
        assert np.abs(response).max() <= 1.0 + 1e-4


def test_ideal_step_reaches_two_over_pi() -> None:
    wide = replace(DEFAULT, sigma_across_px=2.5, sigma_along_rows=7.0, regulariser=1e-3)
    rising = line_response(step_image(50, 180), TABLE, wide)
    falling = line_response(step_image(180, 50), TABLE, wide)
    # The step lies between two columns.
    assert rising[32, 47:49].max() == pytest.approx(2.0 / np.pi, abs=0.02)
    np.testing.assert_allclose(falling, -rising, atol=1e-4)


def test_filter_goes_up_to_where_the_verticals_end() -> None:
    """Windows are cut off at the border, not the image: a step is as good there as elsewhere."""
    response = line_response(step_image(50, 180), TABLE, DEFAULT)
    # In the middle of the image, where verticals are columns.
    np.testing.assert_allclose(response[:, 48], response[32, 48], atol=1e-4)


def test_starts_lie_on_the_horizon_band_highest_first() -> None:
    image = render(CAMERA, [Edge(0.2, 40.0), Edge(-0.1, 90.0)], grey=60.0)
    on_horizon = line_starts(image, TABLE, replace(DEFAULT, start_band_rows=0))
    column = np.rint(on_horizon.column).astype(int)
    np.testing.assert_array_equal(on_horizon.row, np.rint(TABLE.anchor_row[column]).astype(int))
    assert len(on_horizon.first) == 2
    band = line_starts(image, TABLE, replace(DEFAULT, start_band_rows=8))
    off = band.row - np.rint(TABLE.anchor_row[np.rint(band.column).astype(int)])
    assert set(np.unique(off)) == {-8, -4, 0, 4, 8}
    highest = [np.abs(band.value[members(band, first)]).max() for first in band.first]
    assert np.all(np.diff(highest) <= 0.0)
    assert np.all(np.abs(band.value) >= DEFAULT.threshold)


def members(found: LineStarts, first: int) -> list[int]:
    """The maxima of a chain, from top to bottom."""
    chain = [first]
    while found.below[chain[-1]] >= 0:
        chain.append(int(found.below[chain[-1]]))
    return chain


def test_starts_are_on_chains() -> None:
    """What is left out has no maximum of its sign above or below; the columns of an edge have."""
    rng = np.random.default_rng(6)
    image = render(CAMERA, [Edge(0.2, 40.0), Edge(-0.1, 90.0)], grey=60.0, noise=12.0, rng=rng)
    response, band = start_response(image, TABLE, DEFAULT)
    assert band.chained
    every = starts.line_starts(response, band._replace(chained=False), DEFAULT.threshold)
    found = starts.line_starts(response, band, DEFAULT.threshold)
    np.testing.assert_array_equal(found.column, every.column)
    assert 2 <= len(found.first) <= len(every.first) - 4
    for first in found.first:
        chain = members(found, first)
        assert len(chain) >= 2
        assert np.all(np.diff(found.row[chain]) == band.spacing)
        assert np.all(np.abs(np.diff(found.column[chain])) < 1.5)
        assert np.all(found.value[chain] * found.value[first] > 0.0)
    for edge in (0.2, -0.1):
        at = 47.5 - 110.0 * np.tan(edge)
        near = [first for first in found.first if abs(found.column[first] - at) < 1.6]
        assert max(len(members(found, first)) for first in near) >= 3


def test_chains_go_on_with_the_nearest_maximum_of_their_sign() -> None:
    response, band = np.zeros((3, 96), np.float32), start_band(TABLE, DEFAULT)
    for k, row in enumerate([{10: 0.5, 20: -0.5}, {9: -0.5, 11: 0.5, 23: -0.5}, {12: 0.5}]):
        for c, value in row.items():
            response[k, c - 1 : c + 2] = value * np.array([0.2, 1.0, 0.2], np.float32)
    found = starts.line_starts(response, band, 0.1)
    np.testing.assert_allclose(found.column, [10, 20, 9, 11, 23, 12], atol=0.3)
    assert [members(found, first) for first in found.first] == [[0, 3, 5]]


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
    assert tracks.row[0] == DEFAULT.border_rows
    if gap == 5:
        assert last_rows(tracks)[0] == 63 - DEFAULT.border_rows
    else:
        assert last_rows(tracks)[0] < below + 3


def test_tracks_know_polarity_and_follow_subpixel() -> None:
    camera = leaning_camera(CAMERA, (0.0, np.radians(4.0)))
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


def test_tracks_of_lines_leave_edges_that_bend() -> None:
    """An edge that goes straight up, and from some row on leans."""
    rows, columns = np.mgrid[0:64, 0:96]
    edge = 48.0 + 0.4 * np.maximum(rows - 42, 0)
    image = np.where(columns >= edge, 160, 60).astype(np.uint8)
    starts = line_starts(image, TABLE, replace(DEFAULT, start_band_rows=8))
    straight, curved = (
        line_tracks(image, starts, TABLE, replace(DEFAULT, guided=guided))
        for guided in (True, False)
    )
    assert 40 <= last_rows(straight)[0] <= 52
    assert last_rows(curved)[0] >= 58


def test_tracks_are_followed_again_along_verticals() -> None:
    """Past the row from which it leans, an edge is followed by its own lean, but not by a tilt."""
    rows, columns = np.mgrid[0:64, 0:96]
    edge = 60.0 + 0.15 * np.maximum(rows - 42, 0)
    image = np.where((columns >= 30) & (columns < edge), 160, 60).astype(np.uint8)
    starts = line_starts(image, TABLE, DEFAULT)
    tracks = line_tracks(image, starts, TABLE, DEFAULT)
    np.testing.assert_array_equal(np.sort(tracks.polarity), [-1.0, 1.0])
    np.testing.assert_array_equal(last_rows(tracks), 61)
    leaning = tracks.polarity < 0.0
    found = tracks_again(image, starts, tracks, leaning, (0.0, 0.0), TABLE, DEFAULT)
    np.testing.assert_array_equal(found.polarity, [1.0, -1.0])
    assert 45 <= last_rows(found)[1] <= 57
    below = slice(found.bounds[1], found.bounds[2])
    straight = found.row[below] <= 38
    np.testing.assert_allclose(found.column[below][straight], 59.5, atol=0.1)
    # The other is kept as it is.
    (kept,) = np.flatnonzero(~leaning)
    own = slice(tracks.bounds[kept], tracks.bounds[kept + 1])
    for name in ("row", "column", "score"):
        ours, theirs = getattr(found, name)[: found.bounds[1]], getattr(tracks, name)[own]
        np.testing.assert_array_equal(ours, theirs)


def test_edges_that_come_in_at_the_side_are_followed() -> None:
    """At the horizon their windows leave the image, farther down they do not."""
    camera = pinhole(160, 120, 150.0, pitch_deg=15.0)
    table = build_vertical_table(camera)
    side = float(np.interp(157.0, np.arange(160), table.bearing_rad))
    image = render(camera, [Edge(0.1, 80.0), Edge(side, 80.0)], grey=60.0)
    starts = line_starts(image, table, DEFAULT)
    tracks = line_tracks(image, starts, table, DEFAULT)
    again = np.ones(len(tracks.polarity), np.bool_)
    found = tracks_again(image, starts, tracks, again, (0.0, 0.0), table, DEFAULT)
    assert len(found.polarity) == 2
    assert np.diff(found.bounds).min() > 90


def test_no_horizon_no_tracks() -> None:
    table = build_vertical_table(pinhole(96, 64, 110.0, pitch_deg=70.0))
    image = step_image(50, 180)
    response = line_response(image, table, DEFAULT)
    assert not response.any()
    tracks = line_tracks(image, line_starts(image, table, DEFAULT), table, DEFAULT)
    assert len(tracks.polarity) == 0


@pytest.mark.parametrize("preset", [DEFAULT, PUBLISHED], ids=["default", "published"])
@pytest.mark.parametrize("tilt_deg", [0.0, 4.0])
def test_tracks_see_nearly_the_response_of_the_whole_strip(
    preset: LineSettings, tilt_deg: float
) -> None:
    camera = pinhole(160, 120, 150.0, pitch_deg=15.0, roll_deg=0.5 * tilt_deg)
    table = build_vertical_table(camera)
    preset = replace(preset, border_rows=2, threshold=min(preset.threshold, 0.2))
    edges = [Edge(0.3, 60.0), Edge(0.1, -80.0), Edge(-0.2, 50.0)]
    seen = leaning_camera(camera, (0.0, np.radians(tilt_deg)))
    image = render(seen, edges, noise=4.0, rng=np.random.default_rng(1))
    response = line_response(image, table, preset)
    tracks = line_tracks(image, line_starts(image, table, preset), table, preset)
    assert len(tracks.row) > 100
    off = np.abs(highest_near(tracks, response) - tracks.score)
    # Along the edge instead of the vertical a leaning edge is seen a little better.
    assert np.quantile(off, 0.9) <= (0.1 if tilt_deg == 0.0 else 0.12)


def highest_near(tracks: LineTracks, response: np.ndarray) -> np.ndarray:
    """Of the three columns round each point the highest response of its sign."""
    polarity = np.repeat(tracks.polarity, np.diff(tracks.bounds))
    column = np.rint(tracks.column).astype(int)
    around = response[tracks.row[:, None], column[:, None] + [-1, 0, 1]]
    return np.asarray((polarity[:, None] * around).max(axis=1))


def test_tracks_see_nearly_the_same_response_at_the_borders() -> None:
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
        assert len(tracks.row) > 300
        off = np.abs(highest_near(tracks, response) - tracks.score)
        assert np.quantile(off, 0.9) <= 0.1


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
