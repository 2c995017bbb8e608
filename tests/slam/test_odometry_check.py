"""Whether odometry and rows fit each other, with known errors of odometry."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from redetect.landmarks import write_frames
from redetect.plane import chain_steps
from redetect.slam.cli import main
from redetect.slam.commands.map import doubts_of
from redetect.slam.mapping.odometry_check import OdometryCheck, check_odometry
from redetect.slam.mapping.run_map import map_run
from redetect.slam.recording import LineRows, Recording, frames_of_discs
from tests.slam.small_run import small_run
from tests.slam.test_associate_runs import NO_LINES, drive


def _run(seed: int) -> Recording:
    return replace(small_run(seed, steps=120, weave_rad=0.1).recording, lines=LineRows.of())


def _check(recording: Recording) -> OdometryCheck:
    return check_odometry(map_run(recording))


def test_factors_of_odometry_and_of_rows_are_one_if_covariances_are_right() -> None:
    checks = [_check(_run(seed)) for seed in range(1, 9)]
    assert np.mean([check.odometry_factor for check in checks]) == pytest.approx(1.0, abs=0.15)
    assert np.mean([check.rows_factor for check in checks]) == pytest.approx(1.0, abs=0.1)
    lengths = np.array([check.length / check.length_sigma for check in checks])
    turns = np.array([check.turn_per_metre / check.turn_per_metre_sigma for check in checks])
    # The mean of eight squares, with a standard deviation of 0.5.
    assert 0.1 < np.mean(lengths**2) < 2.5
    assert 0.1 < np.mean(turns**2) < 2.5


def test_covariances_of_odometry_that_are_too_small_show_in_its_factor_alone() -> None:
    runs = [_run(seed) for seed in range(1, 5)]
    checks = [_check(replace(run, step_covariance=run.step_covariance / 4.0)) for run in runs]
    assert np.mean([check.odometry_factor for check in checks]) > 1.9
    assert np.mean([check.rows_factor for check in checks]) < 1.3


@pytest.mark.parametrize("times", [1e-2, 3e-3])
def test_odometry_that_is_far_too_optimistic_is_told(times: float) -> None:
    run = _run(1)
    mapped = map_run(replace(run, step_covariance=times * run.step_covariance))
    check = check_odometry(mapped)
    assert check.odometry_factor > 0.1 / times
    assert any("errors of odometry are" in line for line in doubts_of(check, mapped))


def test_wrong_lengths_and_turns_of_odometry_are_found() -> None:
    run = _run(1)
    steps = run.steps * [0.8, 0.8, 1.0]
    found = _check(replace(run, steps=steps))
    assert found.length == pytest.approx(0.25, abs=4.0 * found.length_sigma + 0.02)
    assert abs(found.turn_per_metre) < 0.02
    steps = run.steps.copy()
    steps[:, 2] += 0.03 * np.hypot(steps[:, 0], steps[:, 1])
    found = _check(replace(run, steps=steps))
    assert found.turn_per_metre == pytest.approx(-0.03, abs=4.0 * found.turn_per_metre_sigma)
    assert abs(found.length) < 0.02
    assert abs(found.lag_frames) < 4.0 * found.lag_frames_sigma


@pytest.mark.parametrize("scale", [1.0, 0.9])
def test_random_errors_of_odometry_neither_hide_systematic_ones_nor_look_like_them(
    scale: float,
) -> None:
    rough = np.diag([0.12, 0.12, 0.05]) ** 2
    checks = []
    for seed in range(4):
        run = _run(seed)
        error = np.random.default_rng(seed).multivariate_normal(np.zeros(3), rough, len(run))
        steps = (run.steps + error) * [scale, scale, 1.0]
        covariance = run.step_covariance + rough
        checks.append(_check(replace(run, steps=steps, step_covariance=covariance)))
    sigma = checks[0].length_sigma
    off = np.mean([check.length for check in checks]) - (1.0 / scale - 1.0)
    assert abs(off) < 2.0 * sigma
    assert sigma < 0.04
    turns = [check.turn_per_metre / check.turn_per_metre_sigma for check in checks]
    assert np.max(np.abs(turns)) < 4.0


def test_a_robot_that_turns_on_the_spot_has_no_systematic_error_of_length() -> None:
    """All of its ways are random errors."""
    path = chain_steps(np.tile([0.0, 0.0, 0.1], (126, 1)))
    covariance = np.tile(np.diag([0.02, 0.02, 0.01]) ** 2, (126, 1, 1))
    for seed in range(4):
        discs = np.random.default_rng(seed).uniform(-3.5, 3.5, (25, 2))
        mapped = map_run(drive(path, discs, NO_LINES, seed, covariance))
        check = check_odometry(mapped)
        assert abs(check.length) < 4.0 * check.length_sigma
        assert not any("odometry does not fit" in line for line in doubts_of(check, mapped))


def test_rows_alone_and_one_step_have_no_factor_of_odometry() -> None:
    run = _run(2)
    assert np.isnan(_check(run.part(0, 6)).odometry_factor)
    assert np.isnan(_check(run.part(0, 1)).odometry_factor)
    # Of a first frame that many discs are seen in, numbers of no meaning may be large.
    for seed in range(4):
        discs = np.random.default_rng(seed).uniform(-2.0, 2.0, (25, 2))
        one = _check(drive(chain_steps(np.array([[0.0, -0.3, 0.05]])), discs, NO_LINES, seed))
        numbers = (one.odometry_factor, one.rows_factor, one.length, one.length_sigma)
        assert np.all(np.isnan([*numbers, one.lag_frames, one.lag_frames_sigma]))


@pytest.mark.parametrize("shift", [-0.3, 0.3])  # intervals by which odometry is later
def test_odometry_with_another_clock_is_found(
    shift: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = _run(6)
    steps = run.steps.copy()
    steps[1:-1] -= 0.5 * shift * (run.steps[2:] - run.steps[:-2])
    late = replace(run, steps=steps)
    found = _check(late)
    assert found.lag_frames == pytest.approx(shift, abs=4.0 * found.lag_frames_sigma + 0.05)
    write_frames(tmp_path / "map.circles", frames_of_discs(late))
    assert main(["map", str(tmp_path)]) == 0
    way = "behind" if shift > 0.0 else "ahead of"
    assert f"of the interval between frames {way} them" in capsys.readouterr().out


def test_odometry_that_drives_backward_is_said_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = _run(3)
    backward = replace(run, steps=run.steps * [-1.0, -1.0, 1.0])
    write_frames(tmp_path / "map.circles", frames_of_discs(backward))
    assert main(["map", str(tmp_path)]) == 0
    assert "% shorter; forward is -Y in STEP rows" in capsys.readouterr().out


@pytest.mark.parametrize("scale", [1.0, 0.8])
def test_slam_map_says_what_odometry_does_wrong(
    scale: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = _run(3)
    steps = run.steps * [scale, scale, 1.0]
    write_frames(tmp_path / "map.circles", frames_of_discs(replace(run, steps=steps)))
    assert main(["map", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "factor of odometry alone" in said
    if scale == 1.0:
        assert "does not fit" not in said
        assert "errors of odometry" not in said
    else:
        (line,) = [line for line in said.splitlines() if "does not fit the rows" in line]
        assert "% longer" in line
        assert 22.0 < float(line.split(" % ")[0].split()[-1]) < 28.0


def test_wrong_identifiers_are_not_blamed_on_odometry(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = _run(4)
    ids = run.circles.ids.copy()
    ids[20::40] = ids[20::40] % 14 + 1  # of the next disc
    wrong = replace(run, circles=replace(run.circles, ids=ids))
    write_frames(tmp_path / "map.circles", frames_of_discs(wrong))
    assert main(["map", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "times as large as their covariances state: `slam audit`" in said
    assert "errors of odometry" not in said
    assert main(["map", str(tmp_path), "--loss", "geman-mcclure", "--force"]) == 0
    assert "maps without them" not in capsys.readouterr().out
    assert main(["ekf", str(tmp_path)]) == 0
    assert "errors are much larger than stated: `slam audit`" in capsys.readouterr().out


def test_a_slip_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = _run(5)
    assert _check(run).outliers == 0
    steps = run.steps.copy()
    steps[50] += [0.05, 0.3, 0.2]
    slipped = replace(run, steps=steps)
    found = _check(slipped)
    assert found.outliers >= 1
    assert abs(found.worst_step - 50) <= 2
    write_frames(tmp_path / "map.circles", frames_of_discs(slipped))
    assert main(["map", str(tmp_path)]) == 0
    assert f"most at {run.prefixes[found.worst_step]}\n" in capsys.readouterr().out
