"""Planar ICP: exact poses back, and what does not count."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from redetect.groundtruth.lasers.icp import (
    best_share,
    fit_outline,
    moved,
    nearest_on_segments,
    rigid_fit,
    scan_normals,
)
from redetect.landmarks import wrap_angle
from redetect.plane import apply, between, compose, invert
from tests.groundtruth.lasers.scene import ROOM

FloatArray = NDArray[np.float64]

poses = st.tuples(
    st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(-np.pi, np.pi, exclude_max=True)
).map(np.array)


def on_walls(segments: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    lengths = np.hypot(*(segments[:, 2:] - segments[:, :2]).T)
    k = rng.choice(len(segments), count, p=lengths / lengths.sum())
    t = rng.uniform(0.0, 1.0, (count, 1))
    return np.asarray(segments[k, :2] + t * (segments[k, 2:] - segments[k, :2]))


@given(
    st.lists(st.sampled_from([0.0, 0.01, 0.02, 0.03, 0.05, 0.08, np.inf]) | st.floats(0.0, 0.1)),
    st.floats(0.01, 1.0),
)
def test_the_best_share_is_that_of_the_sorted_distances(squared: list[float], kept: float) -> None:
    """However many of them are equal."""
    inside = sorted(d for d in squared if d <= 0.3 * 0.3)
    last = inside[math.ceil(kept * len(inside)) - 1] if inside else -1.0
    found = best_share(np.array(squared, np.float64), 0.3, kept)
    assert found.tolist() == [d <= last for d in squared]


@given(poses, poses)
def test_motions_are_a_group(a: FloatArray, b: FloatArray) -> None:
    assert compose(a, between(a, b))[:2] == pytest.approx(b[:2], abs=1e-9)
    assert wrap_angle(compose(a, between(a, b))[2] - b[2]) == pytest.approx(0.0, abs=1e-9)
    points = np.array([[0.3, -0.2], [2.0, 1.0]])
    assert apply(a, apply(b, points)) == pytest.approx(apply(compose(a, b), points), abs=1e-9)
    assert apply(invert(a), apply(a, points)) == pytest.approx(points, abs=1e-9)


@given(poses)
def test_rigid_fit_is_exact(pose: FloatArray) -> None:
    points = np.array([[0.0, 0.0], [1.0, 0.2], [-0.5, 2.0], [50.0, 50.0]])
    target = moved(points, pose)
    target[3] += 7.0  # not used
    found = rigid_fit(points, target, np.array([True, True, True, False]))
    assert found[:2] == pytest.approx(pose[:2], abs=1e-9)
    assert wrap_angle(found[2] - pose[2]) == pytest.approx(0.0, abs=1e-9)


def test_nearest_on_segments_by_dense_sampling() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-1.0, 9.0, (60, 2))
    t = np.linspace(0.0, 1.0, 4001)[:, None, None]
    samples = ROOM[None, :, :2] + t * (ROOM[None, :, 2:] - ROOM[None, :, :2])
    distance = np.linalg.norm(points[:, None, None] - samples[None], axis=-1).min(axis=(1, 2))
    near, index, squared = nearest_on_segments(points, ROOM)
    assert np.sqrt(squared) == pytest.approx(distance, abs=2e-3)
    assert np.hypot(*(points - near).T) == pytest.approx(np.sqrt(squared))
    assert index.min() >= 0


@given(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.03, 0.03), st.integers(0, 1000))
@settings(max_examples=25)
def test_exact_points_give_the_exact_pose(dx: float, dy: float, dt: float, seed: int) -> None:
    true = np.array([2.0, -1.0, 0.6])
    points = apply(true, on_walls(ROOM, 300, np.random.default_rng(seed)))
    start = compose(true, np.array([dx, dy, dt]))
    pose, rms_m, count = fit_outline(points, ROOM, start, 0.2, 1.0, 1e-12, 500)
    assert pose == pytest.approx(true, abs=1e-6)
    assert rms_m < 1e-6
    assert count == 300


def test_outliers_beyond_the_gate_and_the_worst_share_do_not_count() -> None:
    points = on_walls(ROOM, 200, np.random.default_rng(5))
    points[:8] += 0.15  # within the gate
    points[8:20] = [4.0, 3.0]
    pose, _, count = fit_outline(points, ROOM, np.zeros(3), 0.3, 0.9, 1e-7, 500)
    assert 170 <= count <= 175  # 169.2 of 188, rounded up; equals count as one
    assert pose == pytest.approx(np.zeros(3), abs=1e-3)
    assert fit_outline(points + 100.0, ROOM, np.zeros(3), 0.3, 0.9, 1e-7, 500)[2] == 0


def test_normals_of_a_scan() -> None:
    points = np.stack([np.linspace(0, 2, 21), np.linspace(0, 1, 21)], axis=-1)
    normals = scan_normals(points, 0.3, 4, 0.25)
    assert np.hypot(*normals.T) == pytest.approx(1.0)
    assert np.abs(normals @ [2.0, 1.0]) == pytest.approx(0.0, abs=1e-12)
    assert not scan_normals(points * 10.0, 0.3, 4, 0.25).any()
