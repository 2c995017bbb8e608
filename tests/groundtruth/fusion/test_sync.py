"""Clocks that are known come back, with deviations that are right; what cannot be told is said."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.groundtruth.cli import main
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import write_json
from redetect.groundtruth.fusion.clock import (
    ClockModel,
    ClockSegment,
    ClockStatus,
    read_clock,
    read_ptpd,
)
from redetect.groundtruth.fusion.coarse_offset import OffsetSearch
from redetect.groundtruth.fusion.stream_errors import white_noise_sigmas
from redetect.groundtruth.fusion.sync import synchronise
from redetect.groundtruth.settings import SyncSettings
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    segments_between_gaps,
    write_planar_poses,
)
from redetect.landmarks import wrap_angle
from tests.groundtruth.fusion.simulated import Clocks, headings_only, joined, simulate

SEGMENT = ClockSegment(10.0, 20.0, 15.0, 0.5, 1.001, 0.0, 1e-3, 1e-4, turned_rad=5.0)


@pytest.mark.parametrize(("offset", "drift"), [(-0.97, -0.0095), (0.0, 0.0), (0.98, 0.0097)])
def test_the_clock_comes_back_from_anywhere_within_the_bounds(offset: float, drift: float) -> None:
    clocks = Clocks(offset_s=offset, drift=drift)
    odometry, truth = simulate(clocks, seed=3)
    (found,) = synchronise(odometry, truth)
    expected = offset + drift * (found.reference_s - 30.0)
    assert abs(found.offset_s - expected) < 0.003
    assert abs(found.rate - 1.0 - drift) < 2e-4
    assert abs(wrap_angle(np.array(found.angle_rad - clocks.angle_rad))) < 0.02
    assert abs(found.offset_s - expected) < 4.0 * found.sigma_offset_s


@pytest.mark.parametrize("drift", [-0.0095, 0.006])
def test_a_drift_is_found_from_minutes(drift: float) -> None:
    """Over them the offset changes by more than a second."""
    (found,) = synchronise(*simulate(Clocks(offset_s=0.1, drift=drift, length_s=240.0), seed=4))
    assert found.status == ClockStatus.OK
    assert abs(found.rate - 1.0 - drift) < 2e-5
    assert abs(found.offset_s - 0.1) < 0.003


def test_gross_errors_of_the_ground_truth_do_not_hide_the_clock() -> None:
    clocks = Clocks(offset_s=0.4, drift=0.0)
    odometry, truth = simulate(clocks, seed=6)
    rng = np.random.default_rng(6)
    gross = rng.random(len(truth)) < 0.2
    poses = truth.poses + gross[:, None] * rng.normal(0.0, [2.0, 2.0, 0.7], (len(truth), 3))
    (found,) = synchronise(odometry, PlanarPoses(truth.times_s, poses, truth.covariances))
    (clean,) = synchronise(odometry, truth.only(~gross))
    assert found.status == ClockStatus.OK
    assert abs(found.offset_s - 0.4) < 4.0 * found.sigma_offset_s
    assert found.sigma_offset_s < 1.5 * clean.sigma_offset_s


def test_a_clock_at_a_bound_is_no_clock() -> None:
    odometry, truth = simulate(Clocks(offset_s=0.8, drift=0.0), seed=3)
    (found,) = synchronise(odometry, truth, SyncSettings(largest_offset_s=0.5))
    assert found.status == ClockStatus.AT_A_BOUND
    assert not found.is_determined
    assert "is at a bound" in found.note
    assert math.isinf(found.sigma_offset_s)


def test_slow_ground_truth_is_met_by_samples_not_by_windows() -> None:
    clocks = Clocks(truth_rate_hz=5.0, truth_sigma_rad=0.005)
    (found,) = synchronise(*simulate(clocks, seed=4))
    assert abs(found.offset_s - clocks.offset_s) < 4.0 * found.sigma_offset_s < 0.02


@pytest.mark.long
def test_deviations_are_right() -> None:
    normalised = []
    for seed in range(8):
        clocks = Clocks(offset_s=-0.4 + 0.05 * seed, drift=-2e-4 + 2.5e-5 * seed, walk=0.01)
        (found,) = synchronise(*simulate(clocks, seed))
        normalised.append(
            (
                (found.offset_s - clocks.offset_s - clocks.drift * (found.reference_s - 30.0))
                / found.sigma_offset_s,
                (found.rate - 1.0 - clocks.drift) / found.sigma_rate,
            )
        )
    squared = np.mean(np.square(normalised), axis=0)
    # The 99 % band of chi-squared with 8 degrees of freedom over 8.
    assert np.all(squared > 0.17)
    assert np.all(squared < 2.74)


@pytest.mark.parametrize("rounded", [False, True])
def test_slow_or_rounded_odometry_does_not_make_clocks_too_certain(rounded: bool) -> None:
    """Its path between samples, or within rounding, is unknown: the likelihood has kinks."""
    errors = []
    for seed in range(4):
        clocks = Clocks(offset_s=0.05 * seed, drift=0.0, walk=0.005)
        odometry, groundtruth = simulate(clocks, seed)
        poses = odometry.poses.copy()
        if rounded:
            poses = np.rint(poses / [0.01, 0.01, 0.01]) * 0.01
        slow = PlanarPoses(odometry.times_s, poses).only(slice(None, None, 1 if rounded else 5))
        (found,) = synchronise(slow, groundtruth)
        errors.append((found.offset_s - clocks.offset_s) / found.sigma_offset_s)
    assert np.sqrt(np.mean(np.square(errors))) < 1.7


def test_a_segment_without_turns_cannot_be_synchronised() -> None:
    straight = simulate(Clocks(turns=False), seed=1)
    (found,) = synchronise(*straight)
    assert found.status == "no turns"
    assert math.isinf(found.sigma_offset_s)


@pytest.mark.long
def test_segments_on_one_line_share_it() -> None:
    pieces = []
    for start in (0.0, 300.0, 700.0):
        # One line: at each visit's middle the offset is what the drift made of it.
        clocks = Clocks(offset_s=0.1 + 5e-5 * (start + 30.0), drift=5e-5, start_s=start, walk=0.01)
        pieces.append(simulate(clocks, seed=int(start)))
    found = synchronise(joined([p[0] for p in pieces]), joined([p[1] for p in pieces]))
    assert len(found) == 3
    for segment in found:
        assert "one line through 3 segments" in segment.note
        assert abs(segment.rate - 1.0 - 5e-5) < 1.5e-5
        assert abs(segment.offset_s - 0.1 - 5e-5 * segment.reference_s) < 0.004


@pytest.mark.long
def test_segments_whose_clock_was_set_between_them_keep_their_own() -> None:
    pieces = [
        simulate(Clocks(offset_s=offset, start_s=start, drift=0.0), seed=8)
        for start, offset in ((0.0, -0.2), (300.0, 0.3))
    ]
    found = synchronise(joined([p[0] for p in pieces]), joined([p[1] for p in pieces]))
    assert [round(segment.offset_s, 2) for segment in found] == [-0.2, 0.3]
    assert all(segment.note == "" for segment in found)


@pytest.mark.long
def test_a_segment_without_turns_is_told_by_the_others() -> None:
    pieces = [
        simulate(Clocks(offset_s=0.2, drift=0.0, start_s=start, turns=turns), seed=8)
        for start, turns in ((0.0, True), (300.0, False), (600.0, True))
    ]
    found = synchronise(joined([p[0] for p in pieces]), joined([p[1] for p in pieces]))
    assert [segment.status for segment in found] == ["ok", "no turns", "ok"]
    assert abs(found[1].offset_s - 0.2) < 0.003


def test_a_segment_after_the_others_has_their_drift() -> None:
    pieces = [
        simulate(Clocks(offset_s=0.0, drift=2e-4, turns=turns, start_s=start, walk=0.001), seed=8)
        for start, turns in ((0.0, True), (3600.0, False))
    ]
    first, last = synchronise(joined([p[0] for p in pieces]), joined([p[1] for p in pieces]))
    assert last.status == ClockStatus.NO_TURNS
    assert last.rate == first.rate
    expected = first.offset_s + (first.rate - 1.0) * (last.reference_s - first.reference_s)
    assert last.offset_s == pytest.approx(expected)


def test_visits_without_odometry_cost_no_other_its_clock() -> None:
    odometry, truth = simulate(Clocks(drift=0.0), seed=3)
    away = truth.only(truth.times_s < 30.0)
    away = PlanarPoses(away.times_s + 400.0, away.poses)
    found = synchronise(odometry, joined([truth, away]))
    assert [segment.status for segment in found] == ["ok", "no turns"]
    assert found[1].note == "no odometry"
    search = OffsetSearch(odometry, [truth, away], 60.0)
    assert search.best_near(away, 3.0, 0.01) == (3.0, 0.0)


@pytest.mark.parametrize("jump_s", [0.08, 0.3, 5.0])
def test_a_clock_set_within_a_segment_is_marked_and_bounded(jump_s: float) -> None:
    clocks = Clocks(offset_s=-0.1, drift=0.0, jump_at_s=25.0, jump_s=jump_s)
    found = synchronise(*simulate(clocks, seed=5))
    assert [segment.status for segment in found] == ["jump", "jump"]
    # Odometry's stamps show it: to a sample, or to the spacing of offsets beyond a second.
    within_s = 0.041 if jump_s < 1.0 else 0.15
    assert abs(found[0].to_s - 25.0) < within_s
    assert abs(found[1].from_s - 25.0) < within_s
    assert abs(found[0].offset_s + 0.1) < 0.02
    assert abs(found[1].offset_s + 0.1 - jump_s) < 0.02


def test_where_a_clock_was_set_on_a_straight_path_is_seen_from_the_stamps() -> None:
    """Headings do not change for eight seconds around it: only a step of odometry's times does."""
    clocks = Clocks(offset_s=0.0, drift=0.0)
    odometry, truth = simulate(clocks, seed=5)

    def with_straight(poses: PlanarPoses) -> PlanarPoses:
        """The path with a pause of turning from 22 s to 30 s."""
        before, after = poses.only(poses.times_s <= 22.0), poses.only(poses.times_s > 22.0)
        between = np.arange(before.times_s[-1], 30.0, np.diff(poses.times_s[:2])[0])[1:]
        still = PlanarPoses(between, np.tile(before.poses[-1], (len(between), 1)))
        return joined([before, still, PlanarPoses(after.times_s + 8.0, after.poses)])

    odometry, truth = with_straight(odometry), with_straight(truth)
    set_back = PlanarPoses(odometry.times_s + 0.3 * (odometry.times_s > 28.0), odometry.poses)
    found = synchronise(set_back, truth)
    assert [segment.status for segment in found] == ["jump", "jump"]
    assert found[0].to_s <= 28.0 + 0.04
    assert found[1].from_s >= 28.0 - 0.04
    assert abs(found[1].offset_s - found[0].offset_s - 0.3) < 0.02


@pytest.mark.long
def test_nothing_is_found_where_nothing_jumped() -> None:
    for seed in range(3):
        (found,) = synchronise(*simulate(Clocks(), seed=20 + seed))
        assert found.status == "ok"


def test_a_few_poses_are_no_segment() -> None:
    """They overlap with odometry; there are not enough of them."""
    odometry, truth = simulate(Clocks(), seed=1)
    first = truth.times_s[0]
    few = joined([truth.only(np.arange(10) + k) for k in (0, len(truth) // 2, len(truth) - 10)])
    found = synchronise(odometry, few)
    assert found[0].from_s == first
    assert {one.note for one in found} == {"10 poses of the ground truth: expected 20 or more"}


def test_streams_that_never_meet_are_refused() -> None:
    odometry, truth = simulate(Clocks(), seed=1)
    late = PlanarPoses(odometry.times_s + 5000.0, odometry.poses)
    with pytest.raises(GroundTruthError, match="do not overlap within 60 s"):
        synchronise(late, truth)
    with pytest.raises(GroundTruthError, match="odometry has 3 poses: expected 20 or more"):
        synchronise(headings_only(np.arange(3.0), np.zeros(3)), truth)


@pytest.mark.parametrize("name", ["largest_offset_s", "largest_drift", "segment_gap_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_settings_that_mean_nothing_are_refused(name: str, value: float) -> None:
    with pytest.raises(GroundTruthError, match=name):
        SyncSettings(**dict[str, Any]({name: value}))
    with pytest.raises(GroundTruthError, match=r"largest_offset_s is 2e\+12: expected above 0"):
        SyncSettings(largest_offset_s=2e12)


@given(
    st.lists(st.floats(-5, 5), min_size=1, max_size=6),
    st.lists(st.floats(0.995, 1.005), min_size=6, max_size=6),
    st.lists(st.floats(-1e3, 1e4), min_size=1, max_size=20),
)
def test_times_go_there_and_back(
    offsets: list[float], rates: list[float], times: list[float]
) -> None:
    segments = tuple(
        replace(
            SEGMENT,
            from_s=100.0 * k,
            to_s=100.0 * k + 30.0,
            reference_s=100.0 * k + 15.0,
            offset_s=offset,
            rate=rate,
        )
        for k, (offset, rate) in enumerate(zip(offsets, rates))
    )
    model = ClockModel(segments)
    again = model.groundtruth_times(model.robot_times(times))
    np.testing.assert_allclose(again, times, atol=1e-6)


def test_a_clock_that_was_set_back_has_no_inverse() -> None:
    model = ClockModel(
        (SEGMENT, replace(SEGMENT, from_s=20.1, to_s=30.0, reference_s=25.0, offset_s=-3.0))
    )
    with pytest.raises(GroundTruthError, match="goes back between"):
        model.groundtruth_times([5.0])


def test_a_segment_of_one_pose_has_times_since_1970() -> None:
    at_s = 1.7e9
    lone = replace(SEGMENT, from_s=at_s + 60.0, to_s=at_s + 60.0, reference_s=at_s + 60.0)
    model = ClockModel((replace(SEGMENT, from_s=at_s, to_s=at_s + 9.0, reference_s=at_s), lone))
    times = at_s + np.array([1.0, 30.0, 60.0, 90.0])
    again = model.groundtruth_times(model.robot_times(times))
    np.testing.assert_allclose(again, times, rtol=0.0, atol=1e-5)


def test_an_hour_of_offsets_does_not_fill_the_memory() -> None:
    rng = np.random.default_rng(35)
    times = np.arange(0.0, 7200.0, 0.5)
    odometry = headings_only(times, np.cumsum(rng.normal(0.0, 0.1, len(times))))
    part = odometry.only(odometry.during(500.0, 600.0))
    part = PlanarPoses(part.times_s - 400.0, part.poses)
    tracemalloc.start()
    found = OffsetSearch(odometry, [part], 3600.0).offset_s([part], 0.0)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found == pytest.approx(400.0)
    assert most < 2e8


def test_noise_of_headings_is_told_from_turning() -> None:
    rng = np.random.default_rng(2)
    times = np.arange(0, 100, 0.02)
    turning = 3.0 * np.sin(0.4 * times) + rng.normal(0, 0.01, len(times))
    noise = white_noise_sigmas(headings_only(times, turning))
    assert noise == pytest.approx([0.0, 0.0, 0.01], rel=0.05)
    # At uneven times, too.
    uneven = np.sort(rng.choice(len(times), 2000, replace=False))
    noise = white_noise_sigmas(headings_only(times[uneven], turning[uneven]))
    assert noise == pytest.approx([0.0, 0.0, 0.01], rel=0.1)


def test_cuts_are_where_the_pauses_are() -> None:
    parts = segments_between_gaps(np.array([0.0, 1.0, 7.0, 8.0, 30.0]), 5.0)
    assert [(part.start, part.stop) for part in parts] == [(0, 2), (2, 4), (4, 5)]


def test_clock_files_come_back(tmp_path: Path) -> None:

    untold = replace(
        SEGMENT, from_s=30.0, to_s=40.0, status=ClockStatus.NO_TURNS, sigma_rate=math.inf
    )
    path = tmp_path / "clock.json"
    write_json(path, {"segments": [asdict(SEGMENT), asdict(untold)]})
    assert read_clock(path).segments == (SEGMENT, untold)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "invalid JSON"),
        ("[" * 100000, "invalid JSON"),
        ("[]", "expected a JSON object"),
        ('{"segments": []}', "segments is \\[\\]: expected a list"),
        ('{"segments": [3]}', "segments is \\[3\\]"),
        ('{"segments": [{"from_s": "a"}]}', "from_s is 'a'"),
        ('{"segments": [{"from_s": 1e999}]}', "from_s is inf"),
    ],
)
def test_malformed_clock_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "clock.json").write_text(text)
    with pytest.raises(GroundTruthError, match=message):
        read_clock(tmp_path / "clock.json")


def test_both_layouts_of_ptpd_are_read(tmp_path: Path) -> None:
    debug = tmp_path / "debug.log"
    debug.write_text(
        "1235561680.5 (ptpd debug) offset from master:           0s      25000ns\n"
        "1235561680.5 (ptpd debug) observed drift:       1500\n"
        "1235561681.5 (ptpd debug) offset from master:           0s     -25000ns\n"
        "noise\n"
    )
    log = read_ptpd(debug)
    np.testing.assert_allclose(log.times_s, [1235561680.5, 1235561681.5])
    clock = tmp_path / "clock.log"
    clock.write_text(
        "12:34:56.789 offset from master: 0s 25000ns\n12: offset from master: 0s 1ns\n"
    )
    np.testing.assert_allclose(read_ptpd(clock).times_s, [np.nan, 12.0])
    np.testing.assert_allclose(log.offset_s, [25e-6, -25e-6])
    np.testing.assert_allclose(log.drift, [1.5e-6, np.nan])

    table = tmp_path / "stats.log"
    table.write_text(
        "# Timestamp, State, Clock ID, One Way Delay, Offset From Master, Slave to Master, "
        "Master to Slave, Observed Drift, Last packet Received\n"
        "2018-04-12 15:22:30.028085, slv, x/1, 0.000033858, -0.000008460, 0.0, 0.0, -16399.8, S\n"
        "2018-04-12 15:22:31.028085, init\n"
    )
    log = read_ptpd(table)
    np.testing.assert_allclose(log.times_s, [1523546550.028085])
    np.testing.assert_allclose(log.offset_s, [-8.46e-6])
    np.testing.assert_allclose(log.drift, [-1.63998e-5])

    (tmp_path / "other.log").write_text("nothing of the kind\n")
    with pytest.raises(GroundTruthError, match="no line reports an offset"):
        read_ptpd(tmp_path / "other.log")


def test_the_command_writes_a_clock(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clocks = Clocks(drift=0.0)
    odometry, truth = simulate(clocks, seed=6)
    write_planar_poses(tmp_path / "odometry.csv", odometry)
    write_planar_poses(tmp_path / "truth.csv", truth)
    (tmp_path / "ptpd.log").write_text(
        "".join(f"{t}: offset from master: 0s 237000000ns\n" for t in range(5, 50, 5))
    )
    command = [
        *("sync", str(tmp_path / "odometry.csv"), str(tmp_path / "truth.csv")),
        *("-o", str(tmp_path / "clock.json"), "--ptpd", str(tmp_path / "ptpd.log")),
    ]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "offset +23" in printed
    assert "ptpd: 9 reports, 9 compared, rms difference" in printed
    clock = read_clock(tmp_path / "clock.json")
    moved = clock.groundtruth_times(odometry.times_s)
    np.testing.assert_allclose(moved, odometry.times_s - 0.237, atol=0.003)
    assert clock.segments[0].status == "ok"
    assert main(command) == 1
    assert "give --force" in capsys.readouterr().err
    straight = PlanarPoses(truth.times_s, 0.0 * truth.poses)
    write_planar_poses(tmp_path / "straight.csv", straight)
    command[2], command[4] = str(tmp_path / "straight.csv"), str(tmp_path / "none.json")
    assert main(command) == 1
    shown = capsys.readouterr()
    assert "cannot be synchronised" in shown.out
    assert shown.err == "error: no segment could be synchronised: no clock file is written\n"
    assert not (tmp_path / "none.json").exists()


@pytest.mark.parametrize("offset_s", [5.3, -29.1])
def test_a_clock_that_is_many_seconds_off_is_found_without_flags(offset_s: float) -> None:
    odometry, truth = simulate(Clocks(drift=4e-5), seed=31)
    # Minutes of odometry around the segment, so that many offsets are possible.
    rng = np.random.default_rng(31)
    before, after = odometry.times_s[0], odometry.times_s[-1]
    around = [
        np.arange(before - 60.0, before - 0.01, 0.02),
        np.arange(after + 0.02, after + 60, 0.02),
    ]
    wander = [np.cumsum(rng.normal(0, 0.004, len(times)).cumsum() / 30.0) for times in around]
    ends = np.unwrap(odometry.poses[:, 2])[[0, -1]]
    longer = joined([
        headings_only(around[0], wander[0] - wander[0][-1] + ends[0]), odometry,
        headings_only(around[1], wander[1] + ends[1]),
    ])  # fmt: skip
    longer = PlanarPoses(longer.times_s + offset_s, longer.poses)
    (found,) = synchronise(longer, truth)
    assert found.status == "ok"
    error = found.offset_s - offset_s - 0.237 - 4e-5 * (found.reference_s - 30.0)
    assert abs(error) < 4.0 * found.sigma_offset_s < 0.02


def test_odometry_of_another_drive_is_not_synchronised() -> None:
    odometry, _ = simulate(Clocks(), seed=32)
    _, truth = simulate(Clocks(), seed=33)
    (found,) = synchronise(odometry, truth)
    assert found.status == "no turns"
    assert "no offset with a drift within 0.01 (--largest-drift)" in found.note
    assert math.isinf(found.sigma_offset_s)


def test_a_robot_that_hardly_turns_is_synchronised_by_its_speed() -> None:
    """Headings alone would give any offset within a second, and a small deviation."""
    rng = np.random.default_rng(34)
    times = np.arange(0.0, 70.0, 0.02)
    speed = np.interp(times, np.arange(0.0, 71.0, 2.5), rng.choice([0.0, 0.3, 0.6], 29))
    heading = 0.002 * np.cumsum(speed) * 0.02
    way = np.cumsum(speed) * 0.02
    exact = np.column_stack([way, 0.0 * way, 0.0 * way])
    own = np.column_stack(
        [1.01 * way, 0.0 * way, heading + np.cumsum(rng.normal(0, 3e-4, len(way)))]
    )
    odometry = PlanarPoses(times + 0.2, own)
    seen = slice(250, 3250, 4)
    noise = rng.normal(size=(len(times[seen]), 3)) * [0.002, 0.002, 0.0035]
    covariances = np.tile(np.diag([4e-6, 4e-6, 1.2e-5]), (len(noise), 1, 1))
    truth = PlanarPoses(times[seen], exact[seen] + noise, covariances)
    for segment in synchronise(odometry, truth):
        if segment.status != "no turns":
            assert abs(segment.offset_s - 0.2) < 4.0 * segment.sigma_offset_s < 0.1


def test_a_clock_set_between_segments_was_set_where_its_times_have_a_gap() -> None:
    later = replace(SEGMENT, from_s=100.0, to_s=110.0, reference_s=105.0, offset_s=8.5, rate=1.0)
    model = ClockModel((replace(SEGMENT, rate=1.0), later))
    exact = np.arange(0.0, 120.0, 0.02)
    robot = exact + np.where(exact < 60.0, 0.5, 8.5)
    np.testing.assert_allclose(model.groundtruth_times(robot), exact, atol=1e-9)
    # Without a gap, as if the clock had been slewed, the offset is interpolated.
    slewed = np.arange(0.5, 118.5, 0.02)
    between = model.groundtruth_times(slewed)
    assert np.all(np.diff(between) > 0.0)
    assert np.abs(np.diff(between) - 0.02).max() < 0.005


def test_slow_odometry_has_no_jumps() -> None:
    """Two samples a second: between them its path is an arc, that of the robot is not."""
    rng = np.random.default_rng(10)
    exact = np.arange(0.0, 70.0, 0.01)
    speed = np.interp(exact, np.arange(0.0, 71.0, 2.0), rng.uniform(0.0, 0.8, 36))
    turning = np.interp(exact, np.arange(0.0, 71.0, 2.0), rng.uniform(-0.6, 0.6, 36))
    theta = np.cumsum(turning) * 0.01
    xy = np.cumsum(speed * np.exp(1j * theta)) * 0.01
    path = np.column_stack([xy.real, xy.imag, theta])
    odometry = PlanarPoses(exact[::50] + 0.2, path[::50])
    noise = rng.normal(size=(len(exact[500:6500:8]), 3)) * [0.002, 0.002, 0.0035]
    covariances = np.tile(np.diag([4e-6, 4e-6, 1.2e-5]), (len(noise), 1, 1))
    truth = PlanarPoses(exact[500:6500:8], path[500:6500:8] + noise, covariances)
    found = synchronise(odometry, truth)
    assert [segment.status for segment in found] == ["ok"]
    assert abs(found[0].offset_s - 0.2) < 0.02


def test_a_first_row_from_before_the_clock_was_set_costs_nothing() -> None:
    """A grid from 1970 on would fill the memory."""
    odometry, truth = simulate(Clocks(start_s=1.2e9), seed=5)
    early = PlanarPoses(np.zeros(1), np.zeros((1, 3)))
    (found,) = synchronise(joined([early, odometry]), truth)
    assert found.status == "ok"
    assert abs(found.offset_s - 0.237) < 0.01


def test_straight_drives_do_not_show_an_offset() -> None:
    """White noise of odometry and poses alone gives the likelihood maxima with a curvature."""
    times = np.arange(0.0, 70.0, 0.02)
    for seed in range(4):
        generator = np.random.default_rng(seed)
        length = 0.01 + generator.normal(size=len(times)) * 0.001
        heading = np.cumsum(generator.normal(size=len(times)) * 0.001)
        steps = length[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
        odometry = PlanarPoses(times + 0.18, np.column_stack([np.cumsum(steps, axis=0), heading]))
        at = np.arange(0.1, 60.0, 0.05)
        poses = np.column_stack([0.5 * at, np.zeros((len(at), 2))])
        poses += generator.normal(size=poses.shape) * 0.01
        covariances = np.tile(1e-4 * np.eye(3), (len(at), 1, 1))
        (found,) = synchronise(odometry, PlanarPoses(at, poses, covariances))
        assert not found.is_determined
