"""What the scanners see of the empty area, and scans put into sets."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from redetect.groundtruth.lasers.acquisition import (
    learn_background,
    sets_of_scans,
)
from redetect.groundtruth.lasers.scanners import Scanner, Scans
from redetect.groundtruth.lasers.tracking_kernels import FixedScanners
from tests.groundtruth.lasers.scene import empty_scans, scanner

FloatArray = NDArray[np.float64]


def test_background_is_learned() -> None:
    rng = np.random.default_rng(1)
    ranges = np.rint(1e3 * rng.normal(3.0, 0.01, (500, 4)) / 10.0).astype(np.uint16) * 10
    ranges[:, 1] = 0  # sees nothing
    ranges[rng.random(500) < 0.3, 2] = 0  # drops out
    ranges[:5, 3] = 1000  # somebody passed
    near_m, quantum_m = learn_background(scanner("a", np.zeros(3)), ranges)
    assert np.isinf(near_m[1])
    assert quantum_m == pytest.approx(0.01)
    assert np.all((near_m[[0, 2, 3]] > 2.85) & (near_m[[0, 2, 3]] < 2.97))


def test_codes_of_beams_without_return_hide_no_rounding() -> None:
    """Scanners write 8191, for example, where nothing is in reach."""
    ranges = np.full((10, 2), 3010, dtype=np.uint16)
    ranges[:, 1] = 8191
    ranges += np.arange(0, 100, 10, dtype=np.uint16)[:, None]
    _, quantum_m = learn_background(scanner("a", np.zeros(3), max_range_m=8.0), ranges)
    assert quantum_m == pytest.approx(0.01)


def test_background_raises_no_false_alarm(
    scanners: tuple[Scanner, ...], tables: FixedScanners
) -> None:
    fresh = empty_scans(scanners, 99, 300)
    for k, scans in enumerate(fresh):
        new = (scans.ranges_mm > 0) & (scans.ranges_mm < tables.near_mm[k])
        assert new.mean() < 1e-4


def test_sets_use_every_scan_once() -> None:
    rng = np.random.default_rng(2)
    scans = []
    for k in range(4):
        times = np.arange(0.0, 4.0, (1.0 + 2e-4 * k) / 75.0) + 0.003 * k
        times = times[rng.random(len(times)) > 0.02]
        scans.append(Scans(times, np.zeros((len(times), 5 + k), dtype=np.uint16)))
    sets = sets_of_scans(scans)
    used = np.sort(sets.rows[sets.rows >= 0])
    assert np.array_equal(used, np.arange(sum(len(s) for s in scans)))
    assert np.all(np.diff(sets.times_s) > 0.0)
    assert np.abs(sets.ages_s).max() <= 1.0 / 75.0
    times = np.concatenate([s.times_s for s in scans])
    seen = sets.rows >= 0
    at = np.where(seen, times[sets.rows], 0.0)
    assert (sets.times_s[:, None] - at)[seen] == pytest.approx(sets.ages_s[seen])
    assert np.all(np.where(seen, sets.ages_s, 0.0).sum(axis=1) == pytest.approx(0.0, abs=1e-9))
