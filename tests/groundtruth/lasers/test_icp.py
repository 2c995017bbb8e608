"""Planar ICP: exact poses back, covariances by Monte Carlo, open directions said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.lasers.icp import (
    IcpSettings,
    icp_to_segments,
    moved,
    nearest_on_segments,
    rigid_fit,
    scan_normals,
    trimmed_variance,
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
    points = apply(invert(true), on_walls(ROOM, 300, np.random.default_rng(seed)))
    start = compose(true, np.array([dx, dy, dt]))
    result = icp_to_segments(points, ROOM, start, IcpSettings(kept=1.0, threshold_m=1e-12))
    assert result.pose == pytest.approx(true, abs=1e-6)
    assert result.rms_m < 1e-6
    assert result.used.all()
    assert len(result.undetermined) == 0


def test_outliers_beyond_the_gate_and_the_worst_share_do_not_count() -> None:
    rng = np.random.default_rng(5)
    points = on_walls(ROOM, 200, rng)
    points[:8] += 0.15  # within the gate
    points[8:20] = [4.0, 3.0]
    result = icp_to_segments(points, ROOM, settings=IcpSettings(gate_m=0.3, kept=0.9))
    assert not result.used[8:20].any()
    assert 170 <= int(result.used.sum()) <= 175  # 169.2 of 188, rounded up; equals count as one
    assert result.pose == pytest.approx(np.zeros(3), abs=1e-3)


@pytest.mark.parametrize("kept", [1.0, 0.95, 0.8])
def test_trimmed_variance_by_monte_carlo(kept: float) -> None:
    rng = np.random.default_rng(6)
    values = np.sort(np.abs(rng.normal(size=400_000)))
    inside = values[: int(kept * len(values))]
    shrinkage, inflation = trimmed_variance(kept)
    assert shrinkage == pytest.approx(float(np.mean(inside**2)), rel=0.01)
    assert inflation >= 1.0


@pytest.mark.parametrize("kept", [1.0, 0.95])
def test_covariance_is_right(kept: float) -> None:
    """Normalised errors squared: their mean over 3, in its own 99.9 % band by Monte Carlo."""
    rng = np.random.default_rng(7)
    true, squared = np.array([1.0, 2.0, 0.5]), []
    box = np.array([[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0]], dtype=np.float64)
    for _ in range(300):
        points = on_walls(box, 120, rng)
        normal = np.where(
            (np.abs(points[:, :1]) < 1e-9) | (np.abs(points[:, :1] - 4.0) < 1e-9), [1.0, 0], [0, 1]
        )
        points = points + 0.01 * rng.normal(size=(120, 1)) * normal
        local = apply(invert(true), points)
        result = icp_to_segments(local, box, true, IcpSettings(kept=kept, threshold_m=1e-9))
        error = result.pose - true
        squared.append(error @ np.linalg.solve(result.covariance, error) / 3.0)
    # Points within a standard deviation of a corner belong to the wrong wall now and then.
    assert 0.8 < float(np.mean(squared)) < 1.25


def test_a_corridor_leaves_its_direction_open() -> None:
    walls = np.array([[-20.0, 0.0, 20.0, 0.0], [-20.0, 2.0, 20.0, 2.0]])
    turned = 0.4
    c, s = np.cos(turned), np.sin(turned)
    points = np.stack([np.linspace(-3, 3, 80), np.tile([0.0, 2.0], 40)], axis=-1)
    noisy = points + [0.0, 1.0] * np.random.default_rng(8).normal(0, 0.01, (80, 1))
    start = np.array([0.0, 0.0, turned])
    result = icp_to_segments(apply(invert(start), noisy), walls, start)
    assert len(result.undetermined) == 1
    assert np.abs(result.undetermined[0]) == pytest.approx([1.0, 0.0, 0.0], abs=1e-3)
    end = np.array([[3.0, 0.0, 3.0, 2.0]])
    with_end = np.vstack([noisy, np.column_stack([np.full(20, 3.0), np.linspace(0.1, 1.9, 20)])])
    local = apply(invert(start), with_end)
    closed = icp_to_segments(local, np.vstack([walls, end]), start)
    assert len(closed.undetermined) == 0
    assert c > s  # the corridor is turned in the points' frame, not in the target's


def test_bad_input_is_said() -> None:
    with pytest.raises(GeometryError, match="expected 3 or more"):
        icp_to_segments(np.full((10, 2), 100.0), ROOM)
    with pytest.raises(GeometryError, match="expected 3 or more"):
        icp_to_segments(np.zeros((0, 2)), ROOM)
    with pytest.raises(GroundTruthError, match="gate_m"):
        IcpSettings(gate_m=0.0)
    with pytest.raises(GroundTruthError, match="kept"):
        IcpSettings(kept=1.5)


def test_normals_of_a_scan() -> None:
    points = np.stack([np.linspace(0, 2, 21), np.linspace(0, 1, 21)], axis=-1)
    normals = scan_normals(points, 0.3, 4, 0.25)
    assert np.hypot(*normals.T) == pytest.approx(1.0)
    assert np.abs(normals @ [2.0, 1.0]) == pytest.approx(0.0, abs=1e-12)
    assert not scan_normals(points * 10.0, 0.3, 4, 0.25).any()
