"""The noise of ranges, bearings and steps is learned from a run, and wrong rows are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.landmarks.map_file import LandmarkMap, MapLandmarks, no_landmarks
from redetect.plane import between
from redetect.slam.filters.localizer import localize_run
from redetect.slam.formats.ranges import Noise, Sightings, estimate_noise, with_noise
from redetect.slam.mapping.run_map import map_run
from redetect.slam.models import disc_in_robot
from redetect.slam.recording import ASSUMED, UNKNOWN_ID, CircleRows, LineRows, Recording

FRAMES, LANDMARKS, PERIOD_S = 500, 12, 0.5
STATED = (0.05, 0.02)


def _run(
    rng: np.random.Generator, ranges: float, bearings: float, steps: float, alike: float = 0.0
) -> tuple[Recording, Sightings, FloatArray, FloatArray]:
    """A robot that drives rounds and sees three landmarks a frame; also its true path and map.

    Factors on the standard deviations, the correlation of a landmark's ranges for five seconds.
    """
    angle = 0.06 * np.arange(FRAMES + 1)
    wave = 3.0 + np.sin(0.37 * angle)
    poses = np.stack([wave * np.cos(angle), wave * np.sin(angle), angle + np.pi], axis=1)
    places = rng.uniform(-6.0, 6.0, (LANDMARKS, 2))
    exact = between(poses[:-1], poses[1:])
    spread = steps * np.sqrt(np.diagonal(ASSUMED.covariance(exact), axis1=1, axis2=2))
    odometry = exact + spread * rng.standard_normal(exact.shape)
    frame = np.repeat(np.arange(FRAMES), 3)
    shown = (np.repeat(np.arange(FRAMES) // 10, 3) * 5 + np.tile(np.arange(3), FRAMES)) % LANDMARKS
    x, y = disc_in_robot(poses[frame + 1], places[shown]).T
    common = np.repeat(rng.standard_normal((FRAMES // 10, 3)), 10, axis=0).ravel()
    own = rng.standard_normal((2, len(frame)))
    error = np.sqrt(alike) * common + np.sqrt(1.0 - alike) * own[0]
    seen = Sightings(
        np.arange(FRAMES, dtype=np.float64) * PERIOD_S,
        frame,
        np.hypot(x, y) + STATED[0] * ranges * error,
        np.arctan2(x, -y) + STATED[1] * bearings * own[1],
        shown + 6,
    )
    rows = CircleRows(frame, np.stack([x, y], axis=1), np.tile(np.eye(2), (len(x), 1, 1)), seen.ids)
    names = tuple(map(str, range(FRAMES)))
    unknown = np.zeros((FRAMES, 3, 3))
    return Recording(names, odometry, unknown, rows, LineRows.of()), seen, poses, places


def _stated(seen: Sightings) -> FloatArray:
    return np.tile(STATED, (len(seen.ids), 1))


@pytest.mark.parametrize(("ranges", "bearings", "steps"), [(0.5, 1.8, 0.7), (2.0, 0.6, 1.5)])
def test_the_noise_of_ranges_bearings_and_steps_is_learned(
    ranges: float, bearings: float, steps: float
) -> None:
    run, seen, *_ = _run(np.random.default_rng(1), ranges, bearings, steps)
    _, noise = estimate_noise(run, seen, _stated(seen))
    assert noise.ranges == pytest.approx(ranges, rel=0.1)
    assert noise.bearings == pytest.approx(bearings, rel=0.1)
    assert noise.steps == pytest.approx(steps, rel=0.15)
    assert noise.range_correlation < 0.1
    assert noise.bearing_correlation < 0.1
    assert noise.outliers == 0


def test_vague_ranges_do_not_shrink_the_map() -> None:
    """Bearings fit the better the nearer a landmark is, unless rows are linearised where it is."""
    run, seen, poses, places = _run(np.random.default_rng(8), 0.5, 1.0, 1.0)
    near = disc_in_robot(poses[seen.frame + 1], places[seen.ids - 6])
    run = replace(run, step_covariance=100.0 * ASSUMED.covariance(run.steps))
    vague, right = Noise(ranges=20.0, range_correlation=1.0), np.ones(len(seen.ids), dtype=np.bool_)
    for at, least, most in ((None, 0.8, 0.95), (near, 0.99, 1.01)):
        found = map_run(with_noise(run, seen, _stated(seen), vague, right, at)).estimate.disc_xy
        sizes = [np.mean(np.hypot(*(xy[:, None] - xy).T)) for xy in (found, places)]
        assert least < sizes[0] / sizes[1] < most


def test_errors_of_a_landmark_that_are_alike_are_found() -> None:
    """Ten sightings of a landmark with one error are worth hardly more than one."""
    run, seen, *_ = _run(np.random.default_rng(2), 1.0, 1.0, 1.0, alike=0.8)
    found, noise = estimate_noise(run, seen, _stated(seen))
    assert noise.range_correlation == pytest.approx(0.8, abs=0.2)
    assert noise.bearing_correlation < 0.1
    xy = found.circles.xy
    radial = np.einsum("ni,nij,nj->n", xy, found.circles.covariance, xy) / np.sum(xy**2, axis=1)
    assert np.median(radial) > 3.0 * STATED[0] ** 2


def test_poses_in_a_map_have_the_errors_that_are_stated_despite_misread_landmarks() -> None:
    rng = np.random.default_rng(3)
    run, seen, poses, places = _run(rng, 0.6, 1.7, 1.3)
    misread = rng.random(len(seen.ids)) < 0.02
    ids = np.where(misread, 6 + (seen.ids - 6 + rng.integers(1, 12, len(misread))) % 12, seen.ids)
    found, noise = estimate_noise(run, seen._replace(ids=ids), _stated(seen))
    lost = found.circles.ids == UNKNOWN_ID
    assert noise.outliers == np.count_nonzero(lost)
    assert np.mean(lost[misread]) > 0.8
    assert np.mean(lost[~misread]) < 0.001
    spread = np.tile(1e-8 * np.eye(2), (LANDMARKS, 1, 1))
    discs = MapLandmarks(
        np.arange(LANDMARKS) + 6, places, spread, np.ones(LANDMARKS, dtype=np.int64)
    )
    path = localize_run(found, LandmarkMap(discs, no_landmarks()), start=poses[0]).path
    off = (path.poses - poses)[1:]
    assert path.covariance is not None
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(path.covariance[1:]), off) / 3.0
    assert 0.8 < np.mean(squared) < 1.2
    assert np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))) < 0.05


def test_steps_that_are_too_long_and_turn_too_little_are_corrected() -> None:
    run, seen, poses, _ = _run(np.random.default_rng(4), 1.0, 1.0, 0.5)
    way = np.hypot(run.steps[:, 0], run.steps[:, 1])
    wrong = run.steps * [1.05, 1.05, 1.0] - way[:, None] * [0.0, 0.0, 0.05]
    found, _ = estimate_noise(replace(run, steps=wrong), seen, _stated(seen))
    exact = between(poses[:-1], poses[1:])
    drift = [abs(np.sum((steps - exact)[:, 2])) for steps in (wrong, found.steps)]
    assert drift[1] < 0.2 * drift[0]
    ways = [np.sum(np.hypot(*steps.T[:2])) for steps in (exact, found.steps)]
    assert ways[1] == pytest.approx(ways[0], rel=0.02)


def test_a_run_that_shows_little_has_the_usual_noise() -> None:
    run, seen, *_ = _run(np.random.default_rng(5), 3.0, 3.0, 3.0)
    part = run.part(0, 10)
    first = slice(len(part.circles))
    few = Sightings(
        seen.times[:10],
        seen.frame[first],
        seen.range_m[first],
        seen.bearing_rad[first],
        seen.ids[first],
    )
    found, noise = estimate_noise(part, few, _stated(few))
    assert noise == Noise()
    np.testing.assert_array_equal(found.step_covariance, ASSUMED.covariance(part.steps))


def test_a_run_without_a_map_has_the_usual_noise() -> None:
    rng = np.random.default_rng(6)
    run, seen, *_ = _run(rng, 1.0, 1.0, 1.0)
    shuffled = seen._replace(ids=rng.permutation(seen.ids))  # no map explains them
    found, noise = estimate_noise(run, shuffled, _stated(seen))
    assert noise == Noise()
    assert "usual" in noise.sentence()
    np.testing.assert_array_equal(found.circles.ids, shuffled.ids)


def test_a_run_without_errors_has_the_usual_noise() -> None:
    """Learned errors would be below the resolution of a log."""
    run, seen, *_ = _run(np.random.default_rng(7), 0.0, 0.0, 0.0)
    found, noise = estimate_noise(run, seen, _stated(seen))
    assert noise == Noise()
    assert np.isfinite(found.step_covariance).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_robot_that_stands_still_has_finite_covariances(seed: int) -> None:
    rng = np.random.default_rng(seed)
    run, seen, *_ = _run(rng, 1.0, 1.0, 1.0)
    still, count = replace(run, steps=np.zeros_like(run.steps)), len(seen.ids)
    seen = seen._replace(
        range_m=3.0 + STATED[0] * rng.standard_normal(count),
        bearing_rad=0.4 * (seen.ids % 3) + STATED[1] * rng.standard_normal(count),
        ids=6 + seen.ids % 3,
    )
    found, _ = estimate_noise(still, seen, _stated(seen))
    assert np.isfinite(found.step_covariance).all()
    assert np.isfinite(found.circles.covariance).all()
