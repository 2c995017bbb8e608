"""Tilt from verticals: known tilts back, honest covariances, outliers left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from detect.line_settings import DEFAULT, numbers_of
from detect.lines import detect_lines
from detect.projection import leaning_camera
from detect.verticals.judgement import share_edges
from detect.verticals.tilt import (
    TiltEstimate,
    agree_on_tilt,
    group_around_strongest,
    levelling_rotation,
)
from lut.verticals import build_vertical_table
from tests.detect.line_scene import Edge, pinhole, render
from tests.detect.verticals.stages import consensus, verticals

SETTINGS = replace(DEFAULT, largest_tilt_deg=5.0)
#: The covariance is that of least squares: lines err one by one.
ONE_BY_ONE = replace(SETTINGS, stray_share=0.0)


def seen_normals(
    rng: np.random.Generator, count: int, tilt_rad: tuple[float, float], deviation_rad: np.ndarray
) -> np.ndarray:
    """Normals of verticals over a view of +-40 deg, as a tilted camera measures them."""
    bearing = rng.uniform(-0.7, 0.7, count)
    level = np.stack([np.cos(bearing), np.sin(bearing), np.zeros(count)], axis=-1)
    real = level + rng.normal(0.0, 1.0, (count, 1)) * deviation_rad[:, None] * [0.0, 0.0, 1.0]
    measured = real @ levelling_rotation(*tilt_rad)
    return np.asarray(measured / np.linalg.norm(measured, axis=1, keepdims=True))


@given(pitch=st.floats(-4.9, 4.9), roll=st.floats(-4.9, 4.9), seed=st.integers(0, 2**31))
def test_exact_verticals_give_the_tilt_back(pitch: float, roll: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = np.radians(pitch), np.radians(roll)
    normal = seen_normals(rng, 20, true, np.zeros(20))
    tilt, consistent = consensus(verticals(normal, 1e-10, 0.01, 3.0), SETTINGS)
    assert tilt is not None
    assert consistent.all()
    np.testing.assert_allclose([tilt.pitch_rad, tilt.roll_rad], true, atol=1e-4)


@pytest.mark.parametrize("true_deg", [(0.0, 0.0), (2.3, 0.0), (-2.1, 1.0), (4.0, -3.0)])
def test_normalised_error_is_one_among_outliers(true_deg: tuple[float, float]) -> None:
    rng = np.random.default_rng(5)
    true = np.radians(true_deg)
    squared, raw = [], []
    for _ in range(300):
        deviation = rng.uniform(0.05, 0.2, 12)
        normal = seen_normals(rng, 12, (true[0], true[1]), np.radians(np.hypot(deviation, 0.03)))
        furniture = rng.normal(size=(4, 3)) * [1.0, 1.0, 0.15]
        furniture /= np.linalg.norm(furniture, axis=1, keepdims=True)
        tilt, consistent = consensus(
            verticals(
                np.concatenate([normal, furniture]),
                np.radians(np.concatenate([deviation, np.full(4, 0.1)])) ** 2,
                np.radians(0.9),
                2.0,
            ),
            ONE_BY_ONE,
        )
        assert tilt is not None
        assert tilt.lines == consistent.sum()
        error = np.array([tilt.pitch_rad, tilt.roll_rad]) - true
        squared.append(error @ np.linalg.solve(tilt.covariance, error) / 2.0)
        raw.append(np.degrees(error))
    assert 0.7 < np.mean(squared) < 1.4
    assert np.all(np.sqrt(np.mean(np.square(raw), axis=0)) < 0.15)


def test_largest_set_wins_over_the_smallest_tilt() -> None:
    rng = np.random.default_rng(1)
    tilted = seen_normals(rng, 8, (0.05, -0.04), np.zeros(8))
    upright = seen_normals(rng, 4, (0.0, 0.0), np.zeros(4))
    tilt, consistent = consensus(
        verticals(np.concatenate([upright, tilted]), 1e-8, 0.01, 3.0), SETTINGS
    )
    assert tilt is not None
    assert (tilt.pitch_rad, tilt.roll_rad) == pytest.approx((0.05, -0.04), abs=5e-4)
    assert consistent[4:].all()
    assert consistent[:4].sum() < 4


def test_order_of_lines_does_not_matter() -> None:
    rng = np.random.default_rng(2)
    normal = seen_normals(rng, 15, (0.02, 0.03), np.full(15, 2e-3))
    weight, order = rng.uniform(1.0, 3.0, 15), rng.permutation(15)
    first, _ = consensus(verticals(normal, 4e-6, 0.015, weight), SETTINGS)
    second, _ = consensus(verticals(normal[order], 4e-6, 0.015, weight[order]), SETTINGS)
    assert isinstance(first, TiltEstimate)
    assert isinstance(second, TiltEstimate)
    assert second.pitch_rad == pytest.approx(first.pitch_rad, abs=1e-12)
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_lines_give_no_estimate(count: int) -> None:
    normal = seen_normals(np.random.default_rng(3), count, (0.0, 0.0), np.zeros(count))
    tilt, consistent = consensus(verticals(normal, 1e-6, 0.01, 1.0), SETTINGS)
    assert tilt is None
    assert consistent.all()
    assert len(consistent) == count


def test_lines_that_no_small_tilt_explains_give_none() -> None:
    normal = seen_normals(np.random.default_rng(4), 10, (0.3, 0.0), np.zeros(10))
    normal = normal[np.abs(normal[:, 1]) > 0.2]
    tilt, consistent = consensus(verticals(normal, 1e-8, 0.01, 1.0), SETTINGS)
    assert tilt is None or tilt.lines < len(normal)
    assert not consistent.all()


def edges_at(
    place: np.ndarray, evidence: np.ndarray, polarity: np.ndarray | None = None
) -> np.ndarray:
    """Edges of lines at bearings in a camera of a thousand pixels per radian."""
    near = np.full(len(place), 1e-3 * DEFAULT.same_edge_px)
    return group_around_strongest(
        place, near, evidence, np.ones(len(place)) if polarity is None else polarity
    )


def test_lines_of_one_edge_tell_as_much_as_one() -> None:
    rng = np.random.default_rng(8)
    bearing = rng.uniform(-0.6, 0.6, 8)
    lean_ = rng.normal(0.0, 1e-3, 8)
    twice = np.repeat(np.arange(8), 2)
    place = bearing[twice] + np.tile([0.0, 1e-3], 8)

    def told(place: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        count = len(place)
        evidence = rng.uniform(10.0, 20.0, count)
        normal = np.stack([np.cos(bearing), np.sin(bearing), -lean_], axis=-1)[which]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        lines = verticals(normal, 1e-6, 0.015, 2.0)
        share_edges(lines, edges_at(place, evidence))
        tilt, _ = agree_on_tilt(lines, numbers_of(DEFAULT))
        assert tilt.lines > 0
        assert lines.weight.sum() == pytest.approx(16.0)
        return np.array([tilt.pitch_rad, tilt.roll_rad]), tilt.covariance

    once, covariance = told(bearing, np.arange(8))
    both, of_both = told(place, twice)
    # Softened, lines of twice the variance pull a little more evenly.
    np.testing.assert_allclose(both, once, atol=0.2 * np.sqrt(covariance[1, 1]))
    np.testing.assert_allclose(np.sqrt(np.diag(of_both)), np.sqrt(np.diag(covariance)), rtol=0.2)


def test_edges_of_other_polarity_or_farther_away_are_not_the_same() -> None:
    lines = verticals(np.zeros((5, 3)), 1e-6, 1.0, 3.0)
    edge = edges_at(
        np.array([0.0, 1e-3, 1e-3, 4e-3, 4.5e-3]),
        np.array([10.0, 12.0, 30.0, 9.0, 8.0]),
        np.array([1.0, 1.0, -1.0, 1.0, 1.0]),
    )
    share_edges(lines, edge)
    np.testing.assert_array_equal(edge, [0, 0, 2, 3, 3])
    np.testing.assert_allclose(lines.variance, [2e-6, 2e-6, 1e-6, 2e-6, 2e-6])
    np.testing.assert_allclose(lines.weight, [1.5, 1.5, 3.0, 1.5, 1.5])


@pytest.mark.parametrize("narrow", [True, False])
def test_blurred_edges_among_texture_do_not_overstate_the_tilt(narrow: bool) -> None:
    """What stands beside an edge is alike on several rows, and pulls at all of them.

    Filters as wide as the blur even that out, and are not believed as far as these edges, which
    stand alone, would allow; narrow ones err by more than they state.
    """
    chosen = replace(DEFAULT, stray_share=0.0)
    chosen = replace(chosen, blurred_widths=()) if narrow else chosen
    camera = pinhole(320, 160, 200.0, pitch_deg=10.0, row_aspect=2.0)
    table = build_vertical_table(camera)
    rng = np.random.default_rng(9)
    squared = []
    for _ in range(16):
        true = np.radians(rng.uniform(-1.5, 1.5, 2))
        bearings = np.linspace(-0.55, 0.55, 7) + rng.uniform(-0.05, 0.05, 7)
        edges = [Edge(b, 60.0 * (-1.0) ** i) for i, b in enumerate(bearings)]
        image = render(leaning_camera(camera, (true[0], true[1])), edges, blur_px=2.5)
        texture = gaussian_filter(rng.normal(0.0, 1.0, image.shape), (1.0, 0.7))
        texture *= 2.5 / texture.std()
        grey = np.clip(np.rint(image + texture), 0, 255).astype(np.uint8)
        found = detect_lines(grey, table, chosen)
        assert found.tilt is not None
        error = np.array([found.tilt.pitch_rad, found.tilt.roll_rad]) - true
        squared.append(error @ np.linalg.solve(found.tilt.covariance, error) / 2.0)
    # Filters narrower than the blur are believed too much.
    low, high = (0.4, 5.0) if narrow else (0.1, 1.6)
    assert low < np.mean(squared) < high
