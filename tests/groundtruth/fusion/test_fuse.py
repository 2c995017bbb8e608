"""Fusion: least squares on small problems, honest covariances, gaps, outliers, spoilt files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter

from groundtruth.cli import main
from groundtruth.errors import GroundTruthError
from groundtruth.fusion.fuse import FuseSettings, fuse
from groundtruth.fusion.movement import movement_problem
from groundtruth.geometry.plane import between, log_motion
from groundtruth.geometry.transforms import exp_se3
from groundtruth.trajectories.interpolation import interpolate_poses
from groundtruth.trajectories.streams import PlanarPoses, read_planar_poses, write_planar_poses
from landmarks import wrap_angle

FloatArray = NDArray[np.float64]
LASER_COVARIANCE = np.array([[4e-4, 1e-4, 0.0], [1e-4, 9e-4, 2e-5], [0.0, 2e-5, 1e-4]])


def drive(
    rng: np.random.Generator, seconds: float, settings: FuseSettings, rate_hz: float = 50.0
) -> tuple[PlanarPoses, PlanarPoses]:
    """True path, and odometry whose errors are exactly as the settings say."""
    times = np.arange(0.0, seconds, 1.0 / rate_hz)
    speed = 0.5 + 0.3 * np.sin(0.3 * times + rng.uniform(0, 6))
    turning = 0.5 * np.sin(0.2 * times + rng.uniform(0, 6))
    step = np.column_stack([speed, 0 * times, turning]) / rate_hz
    # The truth differs from what odometry says by the noise of its movements.
    distance = np.abs(step[:, 0])
    sigma = np.column_stack(
        [
            settings.distance_sigma * np.sqrt(distance),
            settings.lateral_sigma * np.sqrt(distance),
            np.sqrt(
                settings.turn_sigma**2 * np.abs(step[:, 2])
                + settings.turn_per_metre_sigma**2 * distance
            ),
        ]
    )
    return (
        PlanarPoses(times, chain(step + rng.normal(size=step.shape) * sigma, rng.normal(size=3))),
        PlanarPoses(times, chain(step, np.array([7.0, -3.0, 2.0]))),
    )


def chain(steps: FloatArray, start: FloatArray) -> FloatArray:
    poses = [start]
    for dx, dy, turn in steps[1:]:
        x, y, theta = poses[-1]
        c, s = math.cos(theta), math.sin(theta)
        poses.append(np.array([x + c * dx - s * dy, y + s * dx + c * dy, theta + turn]))
    result = np.array(poses)
    result[:, 2] = wrap_angle(result[:, 2])
    return result


def measure(
    rng: np.random.Generator, truth: PlanarPoses, times: FloatArray, covariance: FloatArray
) -> PlanarPoses:
    exact, _ = interpolate_poses(truth, times)
    noise = rng.multivariate_normal(np.zeros(3), covariance, len(exact))
    return PlanarPoses(
        exact.times_s, exact.poses + noise, np.broadcast_to(covariance, (len(exact), 3, 3)).copy()
    )


def normalised_error(poses: PlanarPoses, truth: PlanarPoses) -> FloatArray:
    exact, _ = interpolate_poses(truth, poses.times_s)
    error = poses.poses - exact.poses
    error[:, 2] = wrap_angle(error[:, 2])
    assert poses.covariances is not None
    return np.asarray(np.einsum("ni,nij,nj->n", error, np.linalg.inv(poses.covariances), error))


def arc_ends(arcs: FloatArray) -> FloatArray:
    """(N, 3) where constant rates lead within one unit of time."""
    flat = np.zeros(len(arcs))
    ends = exp_se3(np.column_stack([arcs[:, 0], arcs[:, 1], flat, flat, flat, arcs[:, 2]]))
    return np.column_stack([ends[:, 0, 3], ends[:, 1, 3], np.arctan2(ends[:, 1, 0], ends[:, 0, 0])])


def arc_noise(arc: FloatArray, rates: FloatArray, parts: int = 100) -> FloatArray:
    """Covariance of an arc's end, in the frame of its begin: noise of many parts summed up."""
    end = arc_ends(arc[None])[0]
    here = arc_ends((np.arange(parts)[:, None] + 0.5) / parts * arc)
    direction = here[:, 2] + np.arctan2(arc[1], arc[0])
    by = np.zeros((parts, 3, 3))
    by[:, 0, 0] = by[:, 1, 1] = np.cos(direction)
    by[:, 1, 0] = np.sin(direction)
    by[:, 0, 1] = -by[:, 1, 0]
    by[:, 0, 2], by[:, 1, 2] = here[:, 1] - end[1], end[0] - here[:, 0]
    by[:, 2, 2] = 1.0
    return np.asarray(np.einsum("nij,j,nkj->ik", by, rates / parts, by))


@pytest.mark.parametrize("systematic", [0.0, 1.0])
def test_it_is_the_least_squares_solution(systematic: float) -> None:
    """Filter and smoother together solve the batch problem, up to linearisation."""
    rng = np.random.default_rng(1)
    settings = FuseSettings(
        learn_noise=False,
        turn_scale_sigma=0.03 * systematic,
        turn_bias_per_metre_sigma=0.01 * systematic,
        distance_scale_sigma=0.03 * systematic,
    )
    truth, odometry = drive(rng, 6.0, settings, rate_hz=5.0)
    laser = measure(rng, truth, truth.times_s[[0, 3, 4, 9, 20, 28]], LASER_COVARIANCE / 25)
    found = fuse(odometry, {"laser": laser}, settings).poses
    within = odometry.times_s <= laser.times_s[-1]
    own = odometry.poses[within]

    def movement(path: FloatArray) -> FloatArray:
        change = np.diff(path, axis=0)
        c, s = np.cos(path[:-1, 2]), np.sin(path[:-1, 2])
        return np.column_stack(
            [
                c * change[:, 0] + s * change[:, 1],
                -s * change[:, 0] + c * change[:, 1],
                wrap_angle(change[:, 2]),
            ]
        )

    # Odometry's arcs, put right by the errors, and what their noise sums up to.
    arcs = log_motion(movement(own))
    distinct = movement_problem(odometry, {"laser": laser}, settings).controls[1:, 3]
    distance = np.hypot(arcs[:, 0], arcs[:, 1])
    rates = np.column_stack(
        [
            settings.distance_sigma**2 * distance + 1e-8 * 0.2,
            settings.lateral_sigma**2 * distance + 1e-8 * 0.2,
            settings.turn_sigma**2 * np.abs(arcs[:, 2])
            + settings.turn_per_metre_sigma**2 * distance
            + 1e-8 * 0.2,
        ]
    )
    white = np.array(
        [
            np.linalg.inv(np.linalg.cholesky(arc_noise(arc, rate)))
            for arc, rate in zip(arcs, rates, strict=True)
        ]
    )
    root = np.linalg.inv(np.linalg.cholesky(LASER_COVARIANCE / 25))
    seen = np.searchsorted(odometry.times_s, laser.times_s)

    def residuals(flat: FloatArray) -> FloatArray:
        path, scaled = flat[:-3].reshape(-1, 3), flat[-3:] * systematic
        turn_scale, bend, way_scale = 0.03 * scaled[0], 0.01 * scaled[1], 0.03 * scaled[2]
        right = arcs * [1.0 + way_scale, 1.0 + way_scale, 1.0]
        right[:, 2] += turn_scale * distinct + bend * distance
        off = movement(path) - arc_ends(right)
        off[:, 2] = wrap_angle(off[:, 2])
        difference = path[seen] - laser.poses
        difference[:, 2] = wrap_angle(difference[:, 2])
        return np.concatenate(
            [
                np.einsum("nij,nj->ni", white, off).ravel(),
                (difference @ root.T).ravel(),
                flat[-3:],
            ]
        )

    begin = np.concatenate([found.poses.ravel(), np.zeros(3)])
    solved = least_squares(residuals, begin, x_scale="jac", xtol=1e-12, ftol=1e-12)
    batch = solved.x[:-3].reshape(-1, 3)
    covariance = np.linalg.inv(solved.jac.T @ solved.jac)
    assert found.covariances is not None
    np.testing.assert_allclose(found.poses, batch, atol=5e-4)
    for k in range(len(batch)):
        block = covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        np.testing.assert_allclose(found.covariances[k], block, rtol=0.05, atol=2e-6)


def test_what_odometry_is_off_by_is_found_and_bridges_a_gap() -> None:
    rng = np.random.default_rng(12)
    exact = FuseSettings(
        distance_sigma=0.003, lateral_sigma=0.003, turn_sigma=0.003, turn_per_metre_sigma=0.001
    )
    truth, odometry = drive(rng, 120.0, exact)
    # Odometry that takes turns for 2 % and ways for 1 % shorter than they are, and bends.
    steps = np.diff(odometry.poses, axis=0)
    steps[:, 2] = wrap_angle(steps[:, 2])
    c, s = np.cos(odometry.poses[:-1, 2]), np.sin(odometry.poses[:-1, 2])
    along = (c * steps[:, 0] + s * steps[:, 1]) / 1.01
    turn = (steps[:, 2] - 0.005 * along * 1.01) / 1.02
    own = np.vstack([np.zeros((1, 3)), np.column_stack([along, 0 * along, turn])])
    biased = PlanarPoses(odometry.times_s, chain(own, np.zeros(3)))
    times = np.concatenate([np.arange(0.0, 50.0, 0.1), np.arange(70.0, 119.9, 0.1)])
    fusion = fuse(biased, {"laser": measure(rng, truth, times, LASER_COVARIANCE / 100)})
    learnt = fusion.odometry
    assert abs(learnt.turn_scale - 0.02) < 4 * learnt.turn_scale_sigma < 0.02
    assert abs(learnt.distance_scale - 0.01) < 4 * learnt.distance_scale_sigma < 0.01
    assert abs(learnt.turn_bias_per_metre - 0.005) < 4 * learnt.turn_bias_per_metre_sigma < 0.01
    assert learnt.turn_sigma < 0.01
    exact_poses, _ = interpolate_poses(truth, fusion.poses.times_s)
    off = np.linalg.norm((fusion.poses.poses - exact_poses.poses)[:, :2], axis=1)
    assert np.max(off) < 0.12
    assert np.mean(normalised_error(fusion.poses, truth)) < 9.0


@pytest.mark.long
def test_covariances_are_right() -> None:
    settings = FuseSettings()
    ends, middles = [], []
    for seed in range(50):
        rng = np.random.default_rng(100 + seed)
        truth, odometry = drive(rng, 30.0, settings)
        times = np.concatenate([np.arange(0.0, 8.0, 0.1), np.arange(22.0, 29.9, 0.1)])
        fusion = fuse(odometry, {"laser": measure(rng, truth, times, LASER_COVARIANCE)}, settings)
        squared = normalised_error(fusion.poses, truth)
        ends.append(squared[fusion.poses.times_s < 8.0][200])
        middles.append(squared[np.argmin(np.abs(fusion.poses.times_s - 15.0))])
    # 99.9 % bands of the mean of 50 draws of chi-squared with 3 degrees of freedom.
    for values in (ends, middles):
        assert 2.0 < np.mean(values) < 4.25


@pytest.mark.parametrize("slip", [0.0, 0.006])
def test_a_short_gap_is_as_uncertain_along_the_way_as_across_it(slip: float) -> None:
    """Wheels that err along their way, with and without sideways slip; errors found, not given."""
    along, across, expected = [], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        times = np.arange(0.0, 30.0, 0.02)
        turning = 0.1 * np.sin(0.5 * times + rng.uniform(0, 6))
        steps = 0.02 * np.column_stack([0.6 + 0.0 * times, 0.0 * times, turning])
        truth = PlanarPoses(times, chain(steps, rng.normal(size=3)))
        way = 0.6 * 0.02
        sigmas = np.sqrt(way) * np.array([0.006, slip, 0.004])
        own = steps + rng.normal(size=steps.shape) * sigmas
        odometry = PlanarPoses(times, chain(own, np.zeros(3)))
        seen = np.concatenate([np.arange(0.0, 13.0, 0.04), np.arange(17.0, 29.9, 0.04)])
        spread = np.diag(np.square([1e-3, 1e-3, 3e-3]))
        found = fuse(odometry, {"laser": measure(rng, truth, seen, spread)}).poses
        assert found.covariances is not None
        k = int(np.argmin(np.abs(found.times_s - 15.0)))
        exact = truth.poses[int(np.argmin(np.abs(truth.times_s - found.times_s[k])))]
        c, s = np.cos(exact[2]), np.sin(exact[2])
        turn = np.array([[c, s], [-s, c]])
        error = turn @ (found.poses[k, :2] - exact[:2])
        variances = np.diagonal(turn @ found.covariances[k, :2, :2] @ turn.T)
        along.append(error[0] ** 2 / variances[0])
        across.append(error[1] ** 2 / variances[1])
        expected.append(variances[0])
    # A random walk between two known ends: a quarter of its variance over the whole gap.
    assert np.mean(expected) == pytest.approx(0.25 * 0.006**2 * 0.6 * 4.0, rel=0.1)
    # 99.8 % bands of the mean of 12 draws of chi-squared with 1 degree of freedom.
    for values in (along, across):
        assert 0.18 < np.mean(values) < 2.75


def test_driving_straight_says_nothing_of_turns() -> None:
    """What odometry errs at random is not taken for turns that measured headings deny."""
    rng = np.random.default_rng(13)
    times = np.arange(0.0, 60.0, 0.02)
    steps = 0.02 * np.column_stack([0.7 + 0.0 * times, 0.0 * times, 0.0 * times])
    truth = PlanarPoses(times, chain(steps, np.zeros(3)))
    noise = rng.normal(size=steps.shape) * np.sqrt(0.014) * np.array([0.006, 0.0, 0.004])
    odometry = PlanarPoses(times, chain(steps + noise, np.zeros(3)))
    spread = np.diag(np.square([1e-3, 1e-3, 3e-3]))
    learnt = fuse(odometry, {"laser": measure(rng, truth, times[::2], spread)}).odometry
    assert abs(learnt.turn_scale) < 0.01
    assert learnt.turn_scale_sigma > 0.02
    assert learnt.turn_per_metre_sigma == pytest.approx(0.004, rel=0.2)
    assert learnt.distance_sigma == pytest.approx(0.006, rel=0.2)
    assert learnt.lateral_sigma < 0.001


def test_a_gap_is_bridged_with_covariance_that_grows_towards_its_middle() -> None:
    rng = np.random.default_rng(3)
    truth, odometry = drive(rng, 40.0, FuseSettings())
    times = np.concatenate([np.arange(0.0, 10.0, 0.05), np.arange(30.0, 39.9, 0.05)])
    fusion = fuse(odometry, {"laser": measure(rng, truth, times, LASER_COVARIANCE)})
    assert fusion.poses.covariances is not None
    spread = np.sqrt(np.trace(fusion.poses.covariances[:, :2, :2], axis1=1, axis2=2))
    at = {t: spread[np.argmin(np.abs(fusion.poses.times_s - t))] for t in (5, 12, 20, 28, 35)}
    assert at[5] < at[12] < at[20] > at[28] > at[35]
    assert at[20] > 3.0 * at[5]
    assert len(fusion.poses) == np.count_nonzero(odometry.times_s <= times[-1])


def test_outliers_are_kept_out_and_listed() -> None:
    rng = np.random.default_rng(4)
    truth, odometry = drive(rng, 20.0, FuseSettings())
    laser = measure(rng, truth, np.arange(0.0, 19.9, 0.1), LASER_COVARIANCE)
    laser.poses[50:55, 0] += 1.0
    fusion = fuse(odometry, {"laser": laser})
    np.testing.assert_allclose(
        [rejected.time_s for rejected in fusion.rejected], laser.times_s[50:55]
    )
    exact, _ = interpolate_poses(truth, fusion.poses.times_s)
    assert np.max(np.abs(fusion.poses.poses[:, :2] - exact.poses[:, :2])) < 0.1


def test_a_robot_that_was_carried_away_is_found_again() -> None:
    rng = np.random.default_rng(5)
    truth, odometry = drive(rng, 40.0, FuseSettings())
    moved = PlanarPoses(truth.times_s, truth.poses.copy())
    moved.poses[truth.times_s > 20.0, :2] += [4.0, -3.0]
    laser = measure(rng, moved, np.arange(0.0, 39.9, 0.1), LASER_COVARIANCE)
    fusion = fuse(odometry, {"laser": laser})
    assert len(fusion.restarts_s) == 1
    assert 20.0 < fusion.restarts_s[0] < 25.0
    exact, _ = interpolate_poses(moved, fusion.poses.times_s)
    off = np.linalg.norm(fusion.poses.poses[:, :2] - exact.poses[:, :2], axis=1)
    settled = (fusion.poses.times_s < 19.5) | (fusion.poses.times_s > fusion.restarts_s[0] + 1.0)
    assert np.max(off[settled]) < 0.15


def test_a_gap_too_long_to_be_bridged_parts_the_path_and_no_more() -> None:
    """A quarter of an hour of odometry that bends: poses after it are believed at once."""
    rng = np.random.default_rng(14)
    exact = FuseSettings(distance_sigma=0.01, lateral_sigma=0.0, turn_per_metre_sigma=0.03)
    truth, own = drive(rng, 940.0, exact, rate_hz=10.0)
    steps = between(own.poses[:-1], own.poses[1:])
    steps[:, 2] += 0.02 * np.hypot(steps[:, 0], steps[:, 1])
    odometry = PlanarPoses(own.times_s, chain(np.vstack([np.zeros((1, 3)), steps]), np.zeros(3)))
    seen = np.concatenate([np.arange(0.0, 20.0, 0.1), np.arange(920.0, 939.8, 0.1)])
    fusion = fuse(odometry, {"laser": measure(rng, truth, seen, LASER_COVARIANCE / 10)})
    assert len(fusion.rejected) <= 2
    assert all(time == pytest.approx(920.0, abs=0.2) for time in fusion.restarts_s)
    exact_poses, _ = interpolate_poses(truth, fusion.poses.times_s)
    off = np.linalg.norm((fusion.poses.poses - exact_poses.poses)[:, :2], axis=1)
    near = (fusion.poses.times_s < 20.0) | (fusion.poses.times_s > 920.1)
    assert np.max(off[near]) < 0.1
    assert fusion.poses.covariances is not None
    assert np.all(np.linalg.eigvalsh(fusion.poses.covariances) > 0.0)


def test_a_robot_carried_far_away_is_found_again() -> None:
    """Farther than a restart's own deviation lets anything pass."""
    rng = np.random.default_rng(15)
    truth, odometry = drive(rng, 30.0, FuseSettings())
    moved = PlanarPoses(truth.times_s, truth.poses.copy())
    moved.poses[truth.times_s > 15.0, :2] += [400.0, -300.0]
    laser = measure(rng, moved, np.arange(0.0, 29.9, 0.1), LASER_COVARIANCE)
    fusion = fuse(odometry, {"laser": laser})
    assert len(fusion.restarts_s) == 1
    assert len(fusion.rejected) == 40
    exact, _ = interpolate_poses(moved, fusion.poses.times_s)
    off = np.linalg.norm(fusion.poses.poses[:, :2] - exact.poses[:, :2], axis=1)
    assert np.max(off[fusion.poses.times_s > fusion.restarts_s[0] + 1.0]) < 0.15


def test_two_streams_are_better_than_each() -> None:
    rng = np.random.default_rng(6)
    truth, odometry = drive(rng, 60.0, FuseSettings())
    streams = {
        "laser": measure(rng, truth, np.arange(0.0, 59.9, 0.1), LASER_COVARIANCE),
        "camera": measure(rng, truth, np.arange(0.05, 59.9, 0.2), LASER_COVARIANCE * 4),
    }

    def rms(chosen: dict[str, PlanarPoses]) -> float:
        poses = fuse(odometry, chosen).poses
        exact, _ = interpolate_poses(truth, poses.times_s)
        return float(np.sqrt(np.mean((poses.poses - exact.poses)[:, :2] ** 2)))

    both = rms(streams)
    assert all(both < rms({name: streams[name]}) for name in streams)
    assert both < 0.5 * np.sqrt(np.trace(LASER_COVARIANCE[:2, :2]) / 2)


@pytest.mark.parametrize(
    "covariance",
    [
        np.zeros((3, 3)),
        np.diag([1e-6, 0.0, 1e-6]),
        np.array([[4e-6, 4e-6, 0.0], [4e-6, 4e-6, 0.0], [0.0, 0.0, 1e-6]]),
        np.array([[1e-6, 2e-6, 0.0], [2e-6, 1e-6, 0.0], [0.0, 0.0, 1e-6]]),
    ],
)
def test_covariances_that_rounding_spoilt_are_survived(covariance: FloatArray) -> None:
    rng = np.random.default_rng(7)
    truth, odometry = drive(rng, 10.0, FuseSettings())
    laser = measure(rng, truth, np.arange(0.0, 9.9, 0.02), 1e-6 * np.eye(3))
    spoilt = PlanarPoses(
        laser.times_s, laser.poses, np.broadcast_to(covariance, (len(laser), 3, 3)).copy()
    )
    fusion = fuse(odometry, {"laser": spoilt})
    assert fusion.repaired["laser"] == len(laser)
    assert np.all(np.isfinite(fusion.poses.poses))
    assert fusion.poses.covariances is not None
    assert np.all(np.linalg.eigvalsh(fusion.poses.covariances) > 0.0)
    exact, _ = interpolate_poses(truth, fusion.poses.times_s)
    assert np.max(np.abs((fusion.poses.poses - exact.poses)[:, :2])) < 0.02


def test_a_covariance_that_no_rounding_explains_is_refused() -> None:
    rng = np.random.default_rng(8)
    truth, odometry = drive(rng, 5.0, FuseSettings())
    laser = measure(rng, truth, np.arange(0.0, 4.9, 0.1), LASER_COVARIANCE)
    assert laser.covariances is not None
    laser.covariances[3] = -np.eye(3)
    with pytest.raises(GroundTruthError, match="laser: pose 4 has a covariance with eigenvalue -1"):
        fuse(odometry, {"laser": laser})


def test_what_cannot_be_fused_is_refused() -> None:
    rng = np.random.default_rng(9)
    truth, odometry = drive(rng, 5.0, FuseSettings())
    with pytest.raises(GroundTruthError, match="laser: no covariances"):
        fuse(odometry, {"laser": truth})
    late = measure(rng, truth, np.arange(0.0, 4.0, 0.1), LASER_COVARIANCE)
    with pytest.raises(GroundTruthError, match="no measured pose within the odometry's time"):
        fuse(odometry, {"laser": PlanarPoses(late.times_s + 99, late.poses, late.covariances)})
    with pytest.raises(GroundTruthError, match="gate_probability is 1"):
        FuseSettings(gate_probability=1.0)
    with pytest.raises(GroundTruthError, match="turn_sigma is -1"):
        FuseSettings(turn_sigma=-1.0)


def test_headings_past_pi_in_files_do_no_harm() -> None:
    rng = np.random.default_rng(10)
    truth, odometry = drive(rng, 20.0, FuseSettings())
    laser = measure(rng, truth, np.arange(0.0, 19.9, 0.1), LASER_COVARIANCE)
    slipped = PlanarPoses(laser.times_s, laser.poses.copy(), laser.covariances)
    slipped.poses[::3, 2] -= 2 * math.pi
    np.testing.assert_allclose(
        fuse(odometry, {"laser": slipped}).poses.poses,
        fuse(odometry, {"laser": laser}).poses.poses,
        atol=1e-9,
    )


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(11)
    truth, odometry = drive(rng, 10.0, FuseSettings())
    laser = measure(rng, truth, np.arange(0.0, 9.9, 0.1), LASER_COVARIANCE)
    write_planar_poses(tmp_path / "odometry.csv", odometry)
    write_planar_poses(tmp_path / "laser.csv", laser)
    command = [
        *("fuse", str(tmp_path / "odometry.csv"), "--laser", str(tmp_path / "laser.csv")),
        *("-o", str(tmp_path / "fused.csv")),
    ]
    assert main(command) == 0
    assert "99 from laser; 0 rejected, 0 restarts" in capsys.readouterr().out
    fused = read_planar_poses(tmp_path / "fused.csv")
    assert fused.covariances is not None
    assert (tmp_path / "fused.json").exists()
    assert main(command) == 1
    assert "give --force" in capsys.readouterr().err
    assert main(["fuse", str(tmp_path / "odometry.csv")]) == 1
    assert "expected at least one ground truth" in capsys.readouterr().err


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_odometry_that_errs_smoothly_bridges_long_gaps_and_holes_beside_them(seed: int) -> None:
    """A localisation as odometry: never far off, and wrong for seconds, not from row to row."""
    rng = np.random.default_rng(30 + seed)
    times = np.arange(0.0, 1700.0, 0.1)
    # It turns left more than right: what is learnt of turns counts at the long gaps' ends.
    turning = 0.01 + 0.4 * np.sin(0.3 * times)
    steps = 0.1 * np.column_stack([0.7 + 0.0 * times, 0.0 * times, turning])
    truth = PlanarPoses(times, chain(steps, np.zeros(3)))
    # 50 mm and 1.5 degrees, smooth within a second and forgotten after a few.
    kept = math.exp(-0.1 / 1.5)
    off = lfilter([1.0], [1.0, -2.0 * kept, kept**2], rng.normal(size=(len(times), 3)), axis=0)
    off *= [0.05, 0.05, math.radians(1.5)] / np.std(off, axis=0)
    off += rng.normal(size=off.shape) * [0.001, 0.001, 0.004]
    odometry = PlanarPoses(times, truth.poses + off)
    times = times[:-10]
    long_gap = ((times > 40.0) & (times < 260.0)) | ((times > 300.0) & (times < 1450.0))
    begins = [20.0, 35.0, 260.0, 280.0, 290.0, 1450.0, 1480.0, 1520.0, 1560.0, 1620.0, 1670.0]
    lengths = [5.0, 5.0, 2.0, 5.0, 10.0, 5.0, 20.0, 20.0, 5.0, 20.0, 5.0]
    holes = [(begin, begin + length) for begin, length in zip(begins, lengths)]

    def in_hole(at: FloatArray) -> NDArray[np.bool_]:
        return np.asarray(np.any([(at >= begin) & (at < end) for begin, end in holes], axis=0))

    spread = np.diag(np.square([2e-3, 2e-3, 3e-3]))
    laser = measure(rng, truth, times[~(long_gap | in_hole(times))], spread)
    fusion = fuse(odometry, {"laser": laser})
    assert fusion.restarts_s == ()
    assert fusion.odometry.looser_in_gaps > 1.0
    assert abs(fusion.odometry.turn_bias_per_metre) < 0.005
    found = fusion.poses
    within = in_hole(found.times_s)
    exact, _ = interpolate_poses(truth, found.times_s)
    distance = np.linalg.norm((found.poses - exact.poses)[:, :2], axis=1)
    squared = normalised_error(found, truth) / 3.0
    assert np.mean(distance[within]) < 0.1
    assert 0.3 < np.mean(squared[within]) < 2.0
    assert np.mean(squared) < 2.0


@pytest.mark.parametrize("bend", [-0.02, 0.0, 0.02])
def test_beside_a_long_gap_the_path_is_told_by_its_own_side(bend: float) -> None:
    """Twenty minutes without a pose: for seconds from either end, odometry leads on from there."""
    rng = np.random.default_rng(40)
    exact = FuseSettings(distance_sigma=0.01, lateral_sigma=0.0, turn_per_metre_sigma=0.02)
    truth, own = drive(rng, 1240.0, exact, rate_hz=10.0)
    steps = between(own.poses[:-1], own.poses[1:])
    steps[:, 2] += bend * np.hypot(steps[:, 0], steps[:, 1])
    odometry = PlanarPoses(own.times_s, chain(np.vstack([np.zeros((1, 3)), steps]), np.zeros(3)))
    seen = np.concatenate([np.arange(0.0, 20.0, 0.1), np.arange(1220.0, 1239.8, 0.1)])
    found = fuse(odometry, {"laser": measure(rng, truth, seen, LASER_COVARIANCE / 10)}).poses
    at = found.times_s
    beside = ((at > 20.0) & (at < 25.0)) | ((at > 1215.0) & (at < 1220.0))
    exact_poses, _ = interpolate_poses(truth, at)
    off = np.linalg.norm((found.poses - exact_poses.poses)[:, :2], axis=1)
    assert np.max(off[beside]) < 0.5
    assert np.mean(normalised_error(found, truth)[beside]) < 3.0 * 2.0
    assert np.mean(normalised_error(found, truth)) < 3.0 * 2.0


@pytest.mark.parametrize("turned_rad", [0.0, 2.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_robot_carried_away_in_a_gap_keeps_the_covariance_honest(
    seed: int, turned_rad: float
) -> None:
    """What odometry did not see in a gap is laid to the gap; poses after it are believed."""
    rng = np.random.default_rng(seed)
    truth, odometry = drive(rng, 60.0, FuseSettings())
    moved = PlanarPoses(truth.times_s, truth.poses.copy())
    late = truth.times_s > 30.0
    carried = moved.poses[late, 0] + 1j * moved.poses[late, 1] + (4.0 - 3.0j)
    carried *= np.exp(1j * turned_rad)
    moved.poses[late, 0], moved.poses[late, 1] = carried.real, carried.imag
    moved.poses[late, 2] = wrap_angle(moved.poses[late, 2] + turned_rad)
    seen = np.concatenate([np.arange(0.0, 20.0, 0.1), np.arange(40.0, 59.8, 0.1)])
    fusion = fuse(odometry, {"laser": measure(rng, moved, seen, LASER_COVARIANCE)})
    assert len(fusion.rejected) <= 1
    found = fusion.poses
    at = found.times_s
    exact, _ = interpolate_poses(moved, at)
    off = np.linalg.norm((found.poses - exact.poses)[:, :2], axis=1)
    measured = (at < 20.0) | (at > 40.0)
    assert np.max(off[measured]) < 0.1
    squared = normalised_error(found, moved) / 3.0
    assert np.mean(squared[measured]) < 2.0
    assert np.mean(squared) < 10.0


def test_a_wrong_pose_after_a_gap_is_kept_out() -> None:
    rng = np.random.default_rng(0)
    truth, odometry = drive(rng, 60.0, FuseSettings())
    seen = np.concatenate([np.arange(0.0, 20.0, 0.1), np.arange(40.0, 59.8, 0.1)])
    laser = measure(rng, truth, seen, LASER_COVARIANCE)
    laser.poses[200] += [10.0, 10.0, 1.0]
    fusion = fuse(odometry, {"laser": laser})
    assert [rejected.time_s for rejected in fusion.rejected] == [pytest.approx(40.0)]
    assert fusion.restarts_s == ()
    assert fusion.odometry.looser_in_gaps == 1.0
