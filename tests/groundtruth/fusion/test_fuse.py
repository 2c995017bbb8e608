"""Fusion: least squares on small problems, honest covariances, outliers, spoilt files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from redetect.groundtruth.cli import main
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion.fuse import fuse
from redetect.groundtruth.fusion.inputs import noise_of
from redetect.groundtruth.fusion.movement import movement_problem
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories import se3
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    interpolate_poses,
    read_planar_poses,
    write_planar_poses,
)
from redetect.landmarks import wrap_angle
from redetect.plane import log_motion
from tests.groundtruth.fusion.drives import (
    LASER_COVARIANCE,
    chain,
    drive,
    measure,
    normalised_error,
)

FloatArray = NDArray[np.float64]


def arc_ends(arcs: FloatArray) -> FloatArray:
    """(N, 3) where constant rates lead within one unit of time."""
    flat = np.zeros(len(arcs))
    ends = se3.exp(np.column_stack([arcs[:, 0], arcs[:, 1], flat, flat, flat, arcs[:, 2]]))
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
    problem = movement_problem(odometry, {"laser": laser}, settings)
    states, spreads, _ = problem.smooth(noise_of(settings))
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
    distinct = problem.controls[1:, 3]
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

    begin = np.concatenate([states[:, :3].ravel(), np.zeros(3)])
    solved = least_squares(residuals, begin, x_scale="jac", xtol=1e-12, ftol=1e-12)
    batch = solved.x[:-3].reshape(-1, 3)
    covariance = np.linalg.inv(solved.jac.T @ solved.jac)
    np.testing.assert_allclose(states[:, :3], batch, atol=5e-4)
    for k in range(len(batch)):
        block = covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        np.testing.assert_allclose(spreads[k, :3, :3], block, rtol=0.05, atol=2e-6)


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


def test_driving_straight_says_nothing_of_turns() -> None:
    """What odometry errs at random is not taken for turns that measured headings deny."""
    rng = np.random.default_rng(13)
    times = np.arange(0.0, 60.0, 0.02)
    steps = 0.02 * np.column_stack([0.7 + 0.0 * times, 0.0 * times, 0.0 * times])
    truth = PlanarPoses(times, chain(steps[1:]))
    noise = rng.normal(size=steps.shape) * np.sqrt(0.014) * np.array([0.006, 0.0, 0.004])
    odometry = PlanarPoses(times, chain((steps + noise)[1:]))
    spread = np.diag(np.square([1e-3, 1e-3, 3e-3]))
    learnt = fuse(odometry, {"laser": measure(rng, truth, times[::2], spread)}).odometry
    assert abs(learnt.turn_scale) < 0.01
    assert learnt.turn_scale_sigma > 0.02
    assert learnt.turn_per_metre_sigma == pytest.approx(0.004, rel=0.2)
    assert learnt.distance_sigma == pytest.approx(0.006, rel=0.2)
    assert learnt.lateral_sigma < 0.001


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


def test_the_filter_alone_knows_less_and_as_much_at_the_end() -> None:
    rng = np.random.default_rng(8)
    truth, odometry = drive(rng, 40.0, FuseSettings())
    times = np.concatenate([np.arange(0.0, 10.0, 0.1), np.arange(25.0, 39.9, 0.1)])
    fusion = fuse(odometry, {"laser": measure(rng, truth, times, LASER_COVARIANCE)})
    filtered, smoothed = fusion.filtered, fusion.poses
    np.testing.assert_allclose(filtered.poses[-1], smoothed.poses[-1], atol=0.01)
    spreads = []
    for path in (filtered, smoothed):
        assert path.covariances is not None
        spreads.append(np.trace(path.covariances[:, :2, :2], axis1=1, axis2=2))
    assert np.all(spreads[0] > 0.98 * spreads[1])
    at = int(
        np.searchsorted(smoothed.times_s, 24.9)
    )  # the end of a gap, which the filter can't see
    assert spreads[0][at] > 10.0 * spreads[1][at]
    assert 0.2 < np.mean(normalised_error(filtered, truth)) / 3.0 < 3.0


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
    # It is counted in its own stream, wherever odometry begins.
    late = PlanarPoses(odometry.times_s[10:], odometry.poses[10:])
    with pytest.raises(GroundTruthError, match="laser: pose 4 has"):
        fuse(late, {"laser": laser})


def test_what_cannot_be_fused_is_refused() -> None:
    rng = np.random.default_rng(9)
    truth, odometry = drive(rng, 5.0, FuseSettings())
    with pytest.raises(GroundTruthError, match="laser: no covariances"):
        fuse(odometry, {"laser": truth})
    late = measure(rng, truth, np.arange(0.0, 4.0, 0.1), LASER_COVARIANCE)
    with pytest.raises(GroundTruthError, match="no measured pose within the odometry's time"):
        fuse(odometry, {"laser": PlanarPoses(late.times_s + 99, late.poses, late.covariances)})
    assert late.covariances is not None
    between = PlanarPoses(late.times_s[:1] + 1.003, late.poses[:1], late.covariances[:1])
    with pytest.raises(GroundTruthError, match=r"no sample of odometry from .*\(1\.003 s\)"):
        fuse(odometry, {"laser": between})
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
        *("-o", str(tmp_path / "fused.csv"), "--filtered", str(tmp_path / "filtered.csv")),
    ]
    assert main(command) == 0
    assert "99 from laser; 0 rejected, 0 restarts" in capsys.readouterr().out
    fused = read_planar_poses(tmp_path / "fused.csv")
    assert fused.covariances is not None
    assert (tmp_path / "fused.json").exists()
    filtered = read_planar_poses(tmp_path / "filtered.csv")
    np.testing.assert_array_equal(filtered.times_s, fused.times_s)
    assert main(command) == 1
    assert "give --force" in capsys.readouterr().err
    assert main(["fuse", str(tmp_path / "odometry.csv")]) == 1
    assert "expected at least one ground truth" in capsys.readouterr().err
    # Refused before the fusion, which takes minutes.
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("redetect.groundtruth.commands.fusion.fuse", None)
        assert main([*command, "--leave-out", "--force"]) == 1
    assert "1 segment of ground truth within" in capsys.readouterr().err
