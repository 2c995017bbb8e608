"""Odometry: covariances against the report's printed steps, errors against their covariance."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from redetect.landmarks import Step
from redetect.plane import between
from tests.landmarks.rows import parse_record
from tools.simulator.driving import DriveStyle, drive, measured_steps, robot_tilt, step_covariance

PRINTED_STEPS = [
    "STEP e.0067 0.00391 -0.15602 -0.00218 0.000014424957 0.000000041534 0.000012538057 "
    "0.000018179117 0.000000374277 0.000233656364",
    "STEP e.0068 0.00234 -0.15677 -0.00241 0.000014516278 0.000000028754 0.000012599615 "
    "0.000018361033 0.000000288615 0.000234812837",
]
ROUTE = np.array([[0, 0], [40, 0], [40, 12], [0, 12], [0, 0], [40, 0], [40, 12], [0, 12], [0, 0]])


@pytest.mark.parametrize("row", PRINTED_STEPS)
def test_covariance_is_that_of_the_printed_steps(row: str) -> None:
    step = parse_record(row)
    assert isinstance(step, Step)
    found = step_covariance([step.dx, step.dy, step.dphi])
    printed = [[step.cxx, step.cxy, step.cxphi], [step.cxy, step.cyy, step.cyphi],
               [step.cxphi, step.cyphi, step.cphiphi]]  # fmt: skip
    np.testing.assert_allclose(np.diag(found), np.diag(printed), rtol=0.005)
    np.testing.assert_allclose(found, printed, rtol=0.005, atol=2e-7)


def test_covariance_is_that_of_all_shipped_steps(shared_data: object) -> None:
    from pathlib import Path

    from redetect.landmarks import read_frames

    steps = [f.step for f in read_frames(Path(str(shared_data)) / "dlr" / "map.circles")]
    found = step_covariance([[s.dx, s.dy, s.dphi] for s in steps])
    shipped = np.array([[s.cxx, s.cyy, s.cphiphi] for s in steps])
    ratio = np.diagonal(found, axis1=1, axis2=2) / shipped
    assert len(ratio) == 3297
    assert np.abs(np.median(ratio, axis=0) - 1.0).max() < 0.005
    assert np.abs(np.quantile(ratio, [0.05, 0.95], axis=0) - 1.0).max() < 0.01


def test_straight_step_has_the_closed_form() -> None:
    length = 0.3
    c = step_covariance([0.0, -length, 0.0])
    heading, position = c[2, 2], c[1, 1]
    assert c[0, 0] == pytest.approx(position + heading * length**2 / 3.0, rel=1e-12)
    assert c[0, 2] == pytest.approx(heading * length / 2.0, rel=1e-12)
    assert c[0, 1] == pytest.approx(0.0, abs=1e-18)


def test_errors_match_their_covariance_over_a_long_drive() -> None:
    poses = drive(ROUTE, 1000, DriveStyle(), np.random.default_rng(4))
    squared = []
    for seed in range(5):
        steps = measured_steps(poses, np.random.default_rng(seed))
        error = steps - between(poses[:-1], poses[1:])
        weighted = np.linalg.solve(step_covariance(steps), error[..., None])[..., 0]
        squared.append((error * weighted).sum(axis=1))
    total, count = float(np.sum(squared)), 3 * np.size(squared)
    # Rows have the covariances of the measured, not of the true steps: a percent more or less.
    assert chi2.ppf(1e-4, count) * 0.99 < total < chi2.ppf(1.0 - 1e-4, count) * 1.02


def test_wrong_odometry_is_far_beyond_its_covariance() -> None:
    poses = drive(ROUTE, 300, DriveStyle(), np.random.default_rng(4))
    wrong = np.zeros(300, dtype=bool)
    wrong[100:200] = True
    steps = measured_steps(poses, np.random.default_rng(0), wrong)
    usual = measured_steps(poses, np.random.default_rng(0))
    np.testing.assert_array_equal(steps[~wrong], usual[~wrong])
    total = (steps - between(poses[:-1], poses[1:]))[100:200].sum(axis=0)
    covariance = step_covariance(steps[100:200]).sum(axis=0)
    assert total @ np.linalg.solve(covariance, total) > chi2.ppf(1.0 - 1e-6, 3)


def test_drive_goes_where_the_route_goes() -> None:
    style = DriveStyle(weave_m=0.0)
    poses = drive(ROUTE, 1000, style, np.random.default_rng(1))
    steps = between(poses[:-1], poses[1:])
    assert np.hypot(steps[:, 0], steps[:, 1]).max() < 0.25
    assert np.abs(steps[:, 2]).max() < 0.35
    # Forward is -y of the robot frame.
    assert np.median(steps[:, 1]) < -0.1
    assert np.abs(steps[:, 0]).max() < 0.05
    corners = ROUTE[:-1]
    legs = pairwise(corners)
    off = np.min([_distance(poses[:, :2], a, b) for a, b in legs], axis=0)
    # Rounded corners cut off at most (sqrt 2 - 1) of their radius.
    assert off.max() < 0.42 * style.corner_m


def test_robot_turns_on_the_spot_where_the_route_reverses() -> None:
    out_and_back = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 0.0]])
    poses = drive(out_and_back, 40, DriveStyle(weave_m=0.0), np.random.default_rng(1))
    assert poses[:, 0].max() == pytest.approx(3.0, abs=0.02)
    assert np.abs(poses[:, 1]).max() < 1e-9
    assert abs(poses[-1, 2] - poses[0, 2]) == pytest.approx(np.pi, abs=1e-9)


def test_route_that_is_too_short_is_refused() -> None:
    with pytest.raises(ValueError, match=r"the route is over after \d+ steps: expected 500"):
        drive(ROUTE[:2], 500, DriveStyle(), np.random.default_rng(1))


def test_tilt_is_smooth_and_of_the_given_size() -> None:
    style = DriveStyle(tilt_deg=0.8, constant_tilt_deg=(2.3, -0.5))
    tilt = np.degrees(robot_tilt(20000, style, np.random.default_rng(7)))
    np.testing.assert_allclose(tilt.mean(axis=0), [2.3, -0.5], atol=0.05)
    np.testing.assert_allclose(tilt.std(axis=0), 0.8, rtol=0.05)
    assert np.diff(tilt, axis=0).std() < 0.2 * tilt.std()


def _distance(
    points: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    along = (b - a) / np.linalg.norm(b - a)
    s = np.clip((points - a) @ along, 0.0, np.linalg.norm(b - a))
    return np.asarray(np.linalg.norm(points - a - s[:, None] * along, axis=1))
