"""Normalised estimation error squared (NEES) of both filters' poses, over seeded simulated runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from redetect.array_types import FloatArray
from redetect.landmarks import squared_mahalanobis, wrap_angle
from redetect.landmarks.map_file import LandmarkMap, MapLandmarks
from redetect.slam.filters.ekf_slam import EkfSlam, run_ekf
from redetect.slam.filters.localizer import Localizer
from redetect.slam.filters.run import FilterRun, run_filter
from redetect.slam.models import common_tilt_jacobian, disc_in_robot
from redetect.slam.recording import LineRows
from tests.slam.small_run import CAMERA_XY, SmallRun, small_run

pytestmark = pytest.mark.long

RUNS = 30
#: Enough for what is far outside the band.
FEW_RUNS = 20
NO_LINES = LineRows.of()

Estimate = Callable[[SmallRun, int], FilterRun]


def band(runs: int) -> tuple[float, float]:
    """Where 95 % of the means of `runs` NEES of poses lie if the covariances are right."""
    low, high = chi2.interval(0.95, 3 * runs)
    return low / runs, high / runs


def localized(sigma_m: float, *, exact: bool = False, stated: bool = True) -> Estimate:
    """Localisation in the true map, or in one with errors, which it may state."""

    def estimate(run: SmallRun, seed: int) -> FilterRun:
        rng = np.random.default_rng([seed, 1])

        def measured(xy: FloatArray) -> MapLandmarks:
            noisy = xy + sigma_m * rng.standard_normal(xy.shape)
            covariance = np.tile(stated * sigma_m**2 * np.eye(2), (len(xy), 1, 1))
            ones = np.ones(len(xy), dtype=np.int64)
            return MapLandmarks(1 + np.arange(len(xy)), noisy, covariance, ones)

        known = LandmarkMap(discs=measured(run.disc_xy), lines=measured(run.line_xy))
        localizer = Localizer(known, camera_xy=CAMERA_XY, exact=exact)
        return run_filter(run.recording, localizer)

    return estimate


def mapped(run: SmallRun, _: int) -> FilterRun:
    """EKF-SLAM."""
    return run_ekf(run.recording, EkfSlam(camera_xy=CAMERA_XY))


def true_map(run: SmallRun) -> LandmarkMap:
    """All landmarks at their true places."""

    def exact(xy: FloatArray) -> MapLandmarks:
        ones = np.ones(len(xy), dtype=np.int64)
        return MapLandmarks(1 + np.arange(len(xy)), xy, np.zeros((len(xy), 2, 2)), ones)

    return LandmarkMap(discs=exact(run.disc_xy), lines=exact(run.line_xy))


def tilted(run: SmallRun, seed: int, common_rad: float, own_rad: float) -> SmallRun:
    """The same run with precise rows, displaced by a tilt of all frames and by one of each."""
    circles, rng = run.recording.circles, np.random.default_rng([seed, 2])
    true_xy = disc_in_robot(run.poses[circles.frame + 1], run.disc_xy[circles.ids - 1])
    by_tilt = common_tilt_jacobian(true_xy)
    tilt = common_rad * rng.standard_normal(2)
    tilts = tilt + own_rad * rng.standard_normal((len(run.recording), 2))
    moved = np.einsum("nij,nj->ni", by_tilt, tilts[circles.frame])
    spread = (common_rad**2 + own_rad**2) * by_tilt @ by_tilt.swapaxes(1, 2)
    precise = replace(
        circles,
        xy=true_xy + 0.1 * (circles.xy - true_xy) + moved,
        covariance=0.01 * circles.covariance + spread,
    )
    recording = replace(run.recording, circles=precise, lines=NO_LINES, tilted=True)
    return replace(run, recording=recording)


def mean_nees(
    estimate: Estimate, runs: int, *, lines: bool = False, noise: float = 1.0
) -> FloatArray:
    """(N,) NEES of the pose after each step, mean of all runs; expected is 3."""
    nees = []
    for seed in range(runs):
        run = _run(seed, noise)
        if not lines:
            run = replace(run, recording=replace(run.recording, lines=NO_LINES))
        path = estimate(run, seed).path
        assert path.covariance is not None
        error = path.poses[1:] - run.poses[1:]
        error[:, 2] = wrap_angle(error[:, 2])
        nees.append(squared_mahalanobis(error, path.covariance[1:]))
    return np.asarray(np.mean(nees, axis=0))


@cache
def _run(seed: int, noise: float) -> SmallRun:
    return small_run(seed, noise)


@pytest.mark.parametrize(
    "estimate",
    [localized(0.0), localized(0.05), localized(0.05, exact=True), mapped],
    ids=["localizer, exact map", "map of 5 cm", "map of 5 cm, gains of an exact one", "EKF-SLAM"],
)
@pytest.mark.parametrize("lines", [False, True])
def test_errors_are_as_large_as_covariances_say(estimate: Estimate, lines: bool) -> None:
    nees = mean_nees(estimate, RUNS, lines=lines)
    low, high = band(RUNS)
    # Means of successive steps are correlated: so many of them leave the band together.
    assert np.mean((nees >= low) & (nees <= high)) > 0.85
    assert 2.5 < nees.mean() < 3.5
    assert low < nees[-6:].mean() < high


@pytest.mark.parametrize(
    ("estimate", "noise"),
    [(localized(0.05, stated=False), 1.0), (localized(0.0), 1.44), (mapped, 1.44)],
    ids=["map errors ignored", "localizer", "EKF-SLAM"],
)
def test_what_is_wrong_shows(estimate: Estimate, noise: float) -> None:
    nees = mean_nees(estimate, FEW_RUNS, noise=noise)
    low, high = band(FEW_RUNS)
    assert np.mean((nees >= low) & (nees <= high)) < 0.5
    assert nees.mean() > high


@pytest.mark.parametrize(
    ("common_deg", "own_deg"), [(0.3, 0.0), (0.15, 0.15), (0.0, 0.3)], ids=["common", "both", "own"]
)
def test_a_tilt_that_all_frames_have_in_common_is_considered(
    common_deg: float, own_deg: float
) -> None:
    of_slam, of_localizer, of_discs = list[float](), list[float](), list[float]()
    for seed in range(FEW_RUNS):
        run = tilted(small_run(seed), seed, np.radians(common_deg), np.radians(own_deg))
        variance = run.recording.common_tilt_variance
        ekf = EkfSlam(common_tilt_variance=variance)
        localizer = Localizer(true_map(run), exact=True, common_tilt_variance=variance)
        paths = run_ekf(run.recording, ekf).path, run_filter(run.recording, localizer).path
        for path, nees in zip(paths, (of_slam, of_localizer), strict=True):
            assert path.covariance is not None
            error = path.poses[1:] - run.poses[1:]
            error[:, 2] = wrap_angle(error[:, 2])
            nees.append(squared_mahalanobis(error, path.covariance[1:]).mean() / 3.0)
        found = ekf.landmark_map().discs
        off = found.xy - run.disc_xy[found.ids - 1]
        of_discs.append(squared_mahalanobis(off, found.covariance).mean() / 2.0)
    # Ignored, a common tilt of 0.3 deg gives 1.6, 1.5 and 2.3.
    for nees in (of_slam, of_localizer, of_discs):
        assert 0.75 < np.mean(nees) < 1.25
