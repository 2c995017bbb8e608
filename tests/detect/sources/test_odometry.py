"""Odometry laid over images: trajectories with times, files of STEP rows."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.cli import main
from detect.errors import DetectError
from detect.options import SourceOptions
from detect.sources.image_files import RunFrames
from detect.sources.opening import open_source
from detect.sources.poses import (
    TimedPose,
    carried,
    pose_between,
    rounded,
    step_between,
    tick_poses,
    tum_poses,
    velocity_poses,
)
from redetect.landmarks import read_frames
from redetect.landmarks.frame_files import format_time, read_times

PREFIXES = ["s.0000", "s.0001", "s.0002"]


def write_times(run: Path, times_s: tuple[float, ...]) -> None:
    rows = [format_time(prefix, time_s) for prefix, time_s in zip(PREFIXES, times_s)]
    (run / "s.times").write_text("# times\n" + "\n".join(rows) + "\n")


@pytest.fixture
def timed_run(small_run: Path) -> Path:
    """The small run, with the times of its images."""
    write_times(small_run, (100.0, 100.5, 101.0))
    return small_run


def tum_row(time_s: float, x: float, y: float, theta: float) -> str:
    qz, qw = math.sin(theta / 2), math.cos(theta / 2)
    return f"{time_s:.6f} {x:.6f} {y:.6f} 0.5 0 0 {qz:.9f} {qw:.9f}\n"


def test_a_trajectory_gives_the_steps(timed_run: Path, tmp_path: Path) -> None:
    """A drive 0.3 m forward and 0.1 m to the left, then turning by 0.2 rad on the spot."""
    heading = 0.7
    forward = np.array([math.cos(heading), math.sin(heading)])
    left = np.array([-forward[1], forward[0]])
    places = [np.zeros(2), 0.3 * forward + 0.1 * left, 0.3 * forward + 0.1 * left]
    headings = [heading, heading, heading + 0.2]
    trajectory = tmp_path / "drive.tum"
    trajectory.write_text(
        "# t x y z qx qy qz qw\n"
        + "".join(
            tum_row(100.0 + 0.5 * k, place[0], place[1], theta)
            for k, (place, theta) in enumerate(zip(places, headings))
        )
    )
    assert main(["circles", str(timed_run), "--odometry", str(trajectory)]) == 0
    output = timed_run / "detected.circles"
    first, second, third = (frame.step for frame in read_frames(output))
    assert (first.dx, first.dy, first.dphi) == (0.0, 0.0, 0.0)
    assert (second.dx, second.dy, second.dphi) == pytest.approx((0.1, -0.3, 0.0), abs=1e-5)
    assert (third.dx, third.dy, third.dphi) == pytest.approx((0.0, 0.0, 0.2), abs=1e-5)
    assert "odometry: drive.tum" in output.read_text()
    assert read_times(f"{output}.times") == read_times(timed_run / "s.times")


def test_times_can_be_named(timed_run: Path, tmp_path: Path) -> None:
    (timed_run / "s.times").rename(tmp_path / "x.times")
    trajectory = tmp_path / "a.tum"
    trajectory.write_text(tum_row(100.0, 0, 0, 0) + tum_row(100.6, 0.6, 0, 0))
    options = SourceOptions(odometry=str(trajectory), times=str(tmp_path / "x.times"))
    run = open_source(timed_run, None, options)
    frames = list(run.frames)
    assert [frame.step.prefix for frame in frames] == PREFIXES[:2]  # 101 s: the path has ended
    assert frames[1].step.dy == pytest.approx(-0.5)
    assert run.frames.left_out == 1
    assert list(run.frames)[1].step == frames[1].step  # begun anew
    assert run.frames.left_out == 1


def test_times_by_prefixes_and_by_names(small_run: Path) -> None:
    """Those of a result have the frames' prefixes, which differ from the images' names."""
    steps = small_run / "s.txt"
    steps.write_text(steps.read_text().replace("STEP s.0000", "STEP s.0000.png"))
    (small_run / "s.times").write_text("s.0000.png 1.5\ns.0001 2.5\n")
    assert [frame.time_s for frame in open_source(small_run).frames] == [1.5, 2.5, None]
    images = small_run / "images"
    (images / "s.0000.png").rename(images / "a b.png")
    (small_run / "s.times").write_text("a_b 1.5\n")
    assert [f.time_s for f in open_source(images / "*.png").frames] == [1.5, None, None]


def test_a_run_folder_as_it_is_has_no_times_file(timed_run: Path) -> None:
    """What the data set's folders give is what it always was."""
    assert main(["circles", str(timed_run)]) == 0
    assert not (timed_run / "detected.circles.times").exists()
    assert isinstance(open_source(timed_run).frames, RunFrames)


def test_times_do_not_replace_the_steps_of_a_run_folder(timed_run: Path, tmp_path: Path) -> None:
    (timed_run / "s.times").rename(tmp_path / "x.times")
    steps = [frame.step for frame in open_source(timed_run).frames]
    assert any(step.dy for step in steps)
    named = ["--times", str(tmp_path / "x.times")]
    assert main(["circles", str(timed_run), *named]) == 0
    output = timed_run / "detected.circles"
    assert [frame.step for frame in read_frames(output)] == steps
    assert read_times(f"{output}.times") == read_times(tmp_path / "x.times")


def test_a_renamed_run_folder_keeps_its_steps(small_run: Path, tmp_path: Path) -> None:
    steps = [frame.step for frame in open_source(small_run).frames]
    renamed = small_run.rename(tmp_path / "monday")
    (renamed / "notes.txt").write_text("STEP by step\n")
    run = open_source(renamed)
    assert run.odometry == renamed / "s.txt"
    assert [frame.step for frame in run.frames] == steps
    (renamed / "t.txt").write_bytes((renamed / "s.txt").read_bytes())  # which of them is it?
    assert open_source(renamed).odometry is None


def test_frames_are_in_the_order_of_the_rows(timed_run: Path, tmp_path: Path) -> None:
    rows = [r for r in (timed_run / "s.txt").read_text().splitlines() if r.startswith("STEP")]
    swapped = tmp_path / "swapped.txt"
    swapped.write_text("\n".join([rows[1], rows[0], rows[2]]) + "\n")
    frames = list(open_source(timed_run, None, SourceOptions(odometry=str(swapped))).frames)
    assert [frame.image.stem for frame in frames if frame.image] == ["s.0001", "s.0000", "s.0002"]
    assert [frame.time_s for frame in frames] == [100.5, 100.0, 101.0]


def test_rows_and_images_without_each_other(small_run: Path, tmp_path: Path) -> None:
    rows = [r for r in (small_run / "s.txt").read_text().splitlines() if r.startswith("STEP")]
    other = tmp_path / "other.txt"
    other.write_text("\n".join([rows[0], rows[1].replace("s.0001", "t.0001"), rows[2]]) + "\n")
    run = open_source(small_run, None, SourceOptions(odometry=str(other)))
    frames = list(run.frames)
    assert [frame.step.prefix for frame in frames] == ["s.0000", "t.0001", "s.0002"]
    assert [frame.image is None for frame in frames] == [False, True, False]
    assert run.frames.left_out == 1


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("1 2 3\n", r"a\.tum:1: '1 2 3': expected 8 numbers: t x y z qx qy qz qw"),
        ("# head\n1 0 0 0 0 0 0 nan\n", r"a\.tum:2: .*expected 8 numbers"),
        ("1 0 0 0 0 0 0 2\n", r"a\.tum:1: qx qy qz qw: expected a unit quaternion"),
        ("", r"a\.tum: no pose in it: expected odometry"),
        (tum_row(100.1, 0, 0, 0) + tum_row(100, 0, 0, 0), "comes after that of 100.1"),
        (tum_row(1, 0, 0, 0) + tum_row(1.7e18, 0, 0, 0), "expected seconds, not nanoseconds"),
        (
            tum_row(1e5, 0, 0, 0) + tum_row(1.1e5, 0, 0, 0),
            r"the first pose is of 100000\.000 s, the last image of 101\.000 s",
        ),
    ],
)
def test_malformed_trajectories(timed_run: Path, tmp_path: Path, content: str, told: str) -> None:
    path = tmp_path / "a.tum"
    path.write_text(content)
    run = open_source(timed_run, None, SourceOptions(odometry=str(path)))
    with pytest.raises(DetectError, match=told):
        list(run.frames)


def test_a_missing_trajectory(timed_run: Path, tmp_path: Path) -> None:
    run = open_source(timed_run, None, SourceOptions(odometry=str(tmp_path / "gone.tum")))
    with pytest.raises(DetectError, match="no such TUM trajectory"):
        list(run.frames)


def test_headings_of_quaternions(tmp_path: Path) -> None:
    """Of a robot that is pitched too, the heading is where its X axis points from above."""
    pitch, yaw = 0.3, 2.0
    qw, qx = math.cos(pitch / 2) * math.cos(yaw / 2), -math.sin(pitch / 2) * math.sin(yaw / 2)
    qy, qz = math.sin(pitch / 2) * math.cos(yaw / 2), math.cos(pitch / 2) * math.sin(yaw / 2)
    path = tmp_path / "a.tum"
    path.write_text(f"1 0 0 0 {qx} {qy} {qz} {qw}\n")
    (pose,) = tum_poses(path)
    assert pose.theta == pytest.approx(yaw)


def test_ticks_of_wheels_give_the_path(tmp_path: Path) -> None:
    """1 m ahead, then a quarter of a circle of 0.5 m to the left, then a turn on the spot."""
    base, each = 0.4, 0.001
    way = 0.5 * math.pi / 2
    side = 0.2 * math.pi / 2
    left, right = way - side, way + side
    turn = 0.2 * 0.3
    rows = np.cumsum([[0.0, 0.0], [1.0, 1.0], [left, right], [turn, -turn]], axis=0) / each
    path = tmp_path / "a.ticks"
    path.write_text("# t left right\n" + "".join(f"{k} {a} {b}\n" for k, (a, b) in enumerate(rows)))
    poses = [(p.time_s, p.x, p.y, p.theta) for p in tick_poses(path, base, each)]
    quarter = math.pi / 2
    expected = [(0, 0, 0, 0), (1, 1, 0, 0), (2, 1.5, 0.5, quarter), (3, 1.5, 0.5, quarter - 0.3)]
    np.testing.assert_allclose(poses, expected, atol=1e-12)


def test_velocities_give_steps_with_covariances(timed_run: Path, tmp_path: Path) -> None:
    """0.3 m ahead, then an arc of 0.4 rad to the left over 0.2 m, both in half a second."""
    path = tmp_path / "a.velocities"
    path.write_text(
        "# t v omega sigma_v sigma_omega\n100 0.6 0 0.02 0.03\n100.5 0.4 0.8 0 0\n101 0 0 0 0\n"
    )
    options = SourceOptions(odometry=str(path))
    first, ahead, arc = [frame.step for frame in open_source(timed_run, None, options).frames]
    assert (first.dx, first.dy, first.dphi) == (0.0, 0.0, 0.0)
    assert (ahead.dx, ahead.dy, ahead.dphi) == pytest.approx((0.0, -0.3, 0.0))
    # The heading's error acts on the average for half the way, and varies along it.
    of_turn = 0.5 * 0.03**2
    assert (ahead.cyy, ahead.cphiphi) == pytest.approx((0.5 * 0.02**2, of_turn))
    assert ahead.cxx == pytest.approx(0.5 * 0.02**2 + of_turn * 0.3**2 / 3.0)
    assert ahead.cxphi == pytest.approx(of_turn * 0.15)
    end = 0.5 * (1 - math.cos(0.4)), -0.5 * math.sin(0.4)
    assert (arc.dx, arc.dy) == pytest.approx(end, abs=1e-5)
    assert arc.dphi == pytest.approx(0.4)
    assert arc.cphiphi == 0.0  # not stated


def test_a_gap_of_velocities_is_no_movement_at_the_last_one(
    timed_run: Path, tmp_path: Path
) -> None:
    rows = [(99.0 + 0.1 * k, 0.5, 0.2, 0.01, 0.01) for k in range(15)]
    rows += [(rows[-1][0] + 5.0 + 0.1 * k, 0.0, 0.0, 0.01, 0.01) for k in range(5)]
    path = tmp_path / "a.velocities"
    np.savetxt(path, rows)
    write_times(timed_run, (100.0, 100.4, 105.5))
    options = SourceOptions(odometry=str(path))
    _, before, over = [frame.step for frame in open_source(timed_run, None, options).frames]
    assert before.cxx < 1e-3
    assert over.cxx == 1e6  # nothing is known of it


def test_a_gap_of_ticks_is_no_arc(timed_run: Path, tmp_path: Path) -> None:
    """Ahead, a quarter turn, and ahead, in 5 s without a row: the sums of ticks are of any path."""
    way, side = 1.0, 0.25 * math.pi / 2
    rows = [(99.0 + 0.1 * k, 0.0, 0.0) for k in range(15)]
    rows += [(105.4 + 0.1 * k, 2.0 * way - side, 2.0 * way + side) for k in range(5)]
    path = tmp_path / "a.ticks"
    np.savetxt(path, rows)
    write_times(timed_run, (100.0, 100.4, 105.5))
    options = SourceOptions(odometry=str(path), wheel_base_m=0.5, metres_per_tick=1.0)
    _, before, over = [frame.step for frame in open_source(timed_run, None, options).frames]
    assert (before.cxx, over.cxx) == (0.0, 1e6)


def test_poses_a_second_apart_are_near_enough(timed_run: Path, tmp_path: Path) -> None:
    times = [98.99, 100.0, 101.02, 102.01]
    (tmp_path / "a.tum").write_text("".join(tum_row(t, t - 98.0, 0.0, 0.0) for t in times))
    run = open_source(timed_run, None, SourceOptions(odometry=str(tmp_path / "a.tum")))
    assert [frame.step.prefix for frame in run.frames] == PREFIXES


def test_a_tiny_variance_stays_positive_in_the_file(timed_run: Path, tmp_path: Path) -> None:
    """A gyroscope of 8e-7 rad per root second: what rounding to five decimals adds is more."""
    path = tmp_path / "a.velocities"
    path.write_text("100 0.6 0 1e-3 8e-7\n101 0 0 1e-3 8e-7\n102 0 0 1e-3 8e-7\n")
    options = SourceOptions(odometry=str(path))
    for frame in list(open_source(timed_run, None, options).frames)[1:]:
        s = frame.step
        rounded = np.round(
            [[s.cxx, s.cxy, s.cxphi], [s.cxy, s.cyy, s.cyphi], [s.cxphi, s.cyphi, s.cphiphi]], 12
        )
        assert np.linalg.eigvalsh(rounded)[0] > 1e-12


def test_the_covariance_of_velocities_is_what_random_drives_show(tmp_path: Path) -> None:
    """Monte Carlo: a drive over two rows, with white noise in many short intervals."""
    rng = np.random.default_rng(5)
    count, parts = 20_000, 40
    rows = np.array([[0.0, 0.5, 0.3, 0.05, 0.1], [2.0, 0.3, -0.2, 0.1, 0.05], [3.0, 0, 0, 0, 0]])
    path = tmp_path / "a.velocities"
    np.savetxt(path, rows)
    x, y, theta = np.zeros((3, count))
    for (begin, speed, turning, *sigma), end in zip(rows.tolist(), rows[1:, 0]):
        dt = (end - begin) / parts
        root = math.sqrt(dt)
        for _ in range(parts):
            x += speed * dt * np.cos(theta) + root * sigma[0] * rng.standard_normal(count)
            y += speed * dt * np.sin(theta) + root * sigma[0] * rng.standard_normal(count)
            theta += turning * dt + root * sigma[1] * rng.standard_normal(count)
    last = list(velocity_poses(path))[-1]
    np.testing.assert_allclose(last.covariance, np.cov([x, y, theta]), rtol=0.08, atol=6e-4)


def test_the_shipped_steps_have_the_covariances_of_velocities(
    shared_data: Path, tmp_path: Path
) -> None:
    """The noise of the data set's robot grows with the way of its wheels, 0.25 m from its centre.

    Its variances per metre of that are 8.1e-5 m^2 and 1.5e-3 rad^2.
    """
    steps = [frame.step for frame in read_frames(shared_data / "dlr" / "map.circles")]
    path, rows = tmp_path / "e.velocities", list[list[float]]()
    for number, step in enumerate(steps):
        way = math.hypot(step.dx, step.dy)
        wheels = way + 0.25 * abs(step.dphi)
        sigmas = math.sqrt(8.1e-5 * wheels), math.sqrt(1.5e-3 * wheels)
        rows.append([number, math.copysign(way, -step.dy), step.dphi, *sigmas])
    np.savetxt(path, [*rows, [len(steps), 0.0, 0.0, 0.0, 0.0]])
    along = list(velocity_poses(path))
    found = [step_between("e", *ends) for ends in pairwise(along)]
    for name in ("cxx", "cyy", "cphiphi"):
        ratio = [getattr(a, name) / getattr(b, name) for a, b in zip(found, steps)]
        assert np.percentile(ratio, [1, 16, 84, 99]) == pytest.approx(1.0, abs=0.04)
        assert np.percentile(ratio, [16, 84]) == pytest.approx(1.01, abs=0.01)
    lever = [(a.cxphi - b.cxphi) / math.sqrt(b.cxx * b.cphiphi) for a, b in zip(found, steps)]
    assert np.abs(np.percentile(lever, [1, 99])).max() < 0.03


@pytest.mark.parametrize("turn", [2**bits for bits in (8, 10, 12, 14, 16, 24, 32)])
@pytest.mark.parametrize("signed", [False, True])
def test_counters_of_ticks_may_overflow(turn: int, signed: bool, tmp_path: Path) -> None:
    low = -turn // 2 if signed else 0
    path = tmp_path / "a.ticks"
    count = [turn - 50 + 20 * k for k in range(6)]
    path.write_text("".join(f"{k} {(n % turn) + low} {(-n % turn) + low}\n"
                            for k, n in enumerate(count)))  # fmt: skip
    poses = list(tick_poses(path, 0.4, 0.001))
    np.testing.assert_allclose([p.theta for p in poses], -0.1 * np.arange(6.0), atol=1e-9)


def test_a_counter_that_starts_anew_is_a_jump(timed_run: Path, tmp_path: Path) -> None:
    """Only the left one does: a circle of the wheel base's size, driven many times, in 50 ms."""
    counts = [(30_000 + 20 * k, 30_000 + 20 * k) for k in range(30)]
    rows = [(99.9 + 0.05 * k, left * (k < 20), right) for k, (left, right) in enumerate(counts)]
    path = tmp_path / "a.ticks"
    np.savetxt(path, rows)
    options = SourceOptions(odometry=str(path), wheel_base_m=0.5, metres_per_tick=1e-3)
    _, before, over = [frame.step for frame in open_source(timed_run, None, options).frames]
    assert (before.dy, before.cxx) == pytest.approx((-0.2, 0.0))
    assert over.cxx == 1e6


@pytest.mark.parametrize(
    "counts",
    [
        [60_000 * k for k in range(6)],
        [-60_000 * k for k in range(6)],
        [0, 30_000, 60_000] * 3,
        [0, 200, 210, 220],
        [0, 3500, 3600, 3700],
    ],
)
def test_fast_counters_of_ticks_do_not_overflow(counts: list[int], tmp_path: Path) -> None:
    path = tmp_path / "a.ticks"
    path.write_text("".join(f"{k} {n} {n}\n" for k, n in enumerate(counts)))
    ways = [math.copysign(math.hypot(p.x, p.y), p.x) for p in tick_poses(path, 0.4, 0.001)]
    np.testing.assert_allclose(ways, 0.001 * np.array(counts), atol=1e-9)


@pytest.mark.parametrize(
    ("content", "wheels", "told"),
    [
        ("1 2\n", (0.4, 0.01), r"a\.ticks:1: '1 2': expected 3 numbers: t left right"),
        ("1 2 3\n", (0.0, 0.01), "expected --wheel-base-m and --metres-per-tick above 0"),
        ("1 0 0\n2 1e200 0\n", (0.4, 0.01), r"a\.ticks:2: expected distance and turn of at most"),
    ],
)
def test_malformed_ticks(
    timed_run: Path, tmp_path: Path, content: str, wheels: tuple[float, float], told: str
) -> None:
    path = tmp_path / "a.ticks"
    path.write_text(content)
    options = SourceOptions(odometry=str(path), wheel_base_m=wheels[0], metres_per_tick=wheels[1])
    with pytest.raises(DetectError, match=told):
        list(open_source(timed_run, None, options).frames)


# -- laws -----------------------------------------------------------------------------------

finite = st.floats(-50.0, 50.0)
angle = st.floats(-3.0, 3.0)
poses = st.builds(TimedPose, st.just(0.0), finite, finite, angle)


@given(poses, poses)
def test_movements_lead_from_one_pose_to_the_other(before: TimedPose, after: TimedPose) -> None:
    step = step_between("e.0000", before, after)
    left, forward, turn = step.dx, -step.dy, step.dphi
    x = before.x + math.cos(before.theta) * forward - math.sin(before.theta) * left
    y = before.y + math.sin(before.theta) * forward + math.cos(before.theta) * left
    assert (x, y) == pytest.approx((after.x, after.y), abs=1e-9)
    assert math.cos(before.theta + turn - after.theta) == pytest.approx(1.0)


def test_a_movements_covariance_is_what_random_drives_show() -> None:
    """Monte Carlo: poses scatter as odometry lets them; the step between as is said of it."""
    rng = np.random.default_rng(11)
    count = 200_000
    start_covariance = np.array([[4e-4, 1e-4, 5e-5], [1e-4, 2e-4, -3e-5], [5e-5, -3e-5, 3e-4]])
    step_covariance = np.array([[3e-4, -5e-5, 2e-5], [-5e-5, 1e-4, 1e-5], [2e-5, 1e-5, 2e-4]])
    start, step = np.array([1.0, 2.0, 0.8]), np.array([0.5, 0.1, 0.3])  # forward, left, turn
    starts = rng.multivariate_normal(start, start_covariance, count)
    steps = rng.multivariate_normal(step, step_covariance, count)
    cos, sin = np.cos(starts[:, 2]), np.sin(starts[:, 2])
    ends = starts + np.column_stack(
        [cos * steps[:, 0] - sin * steps[:, 1], sin * steps[:, 0] + cos * steps[:, 1], steps[:, 2]]
    )
    before = TimedPose(0.0, start[0], start[1], start[2], np.cov(starts.T))
    end = ends.mean(axis=0)
    after = TimedPose(1.0, end[0], end[1], end[2], np.cov(ends.T))
    s = step_between("e.0000", before, after)
    found = [[s.cxx, s.cxy, s.cxphi], [s.cxy, s.cyy, s.cyphi], [s.cxphi, s.cyphi, s.cphiphi]]
    to_dataset = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    expected = to_dataset @ step_covariance @ to_dataset.T
    np.testing.assert_allclose(found, expected, atol=8e-6)


@given(st.floats(0.0, 1.0), poses, poses)
def test_poses_between_are_between(share: float, before: TimedPose, after: TimedPose) -> None:
    first = TimedPose(5.0, before.x, before.y, before.theta)
    second = TimedPose(7.0, after.x, after.y, after.theta)
    pose = pose_between(first, second, 5.0 + 2.0 * share)
    assert pose.x == pytest.approx((1 - share) * before.x + share * after.x, abs=1e-9)
    turned = abs(math.remainder(pose.theta - before.theta, 2 * math.pi))
    whole = abs(math.remainder(after.theta - before.theta, 2 * math.pi))
    assert turned <= whole + 1e-9


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("1 2 3\n", r":1: '1 2 3': expected 5 numbers: t v omega sigma_v sigma_omega"),
        ("1 0 0 0 -0.1\n2 0 0 0 0\n", r":1: expected sigmas of 0 or more"),
        ("1 1e200 0 0 0\n2 0 0 0 0\n", r":2: expected distance and turn of at most"),
        ("2 0 0 0 0\n1 0 0 0 0\n101 0 0 0 0\n", r"the pose of 1\.0+ s comes after that of 2"),
    ],
)
def test_malformed_velocities(timed_run: Path, tmp_path: Path, content: str, told: str) -> None:
    path = tmp_path / "a.velocities"
    path.write_text(content)
    with pytest.raises(DetectError, match=told):
        list(open_source(timed_run, None, SourceOptions(odometry=str(path))).frames)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_parts_of_a_movement_have_valid_covariances(one: float, other: float) -> None:
    """Images are often faster than odometry, whose heading's errors move its end aside."""
    grown = np.array([[1e-4, 0.0, 0.0], [0.0, 0.09 / 3.0 + 1e-9, 0.15], [0.0, 0.15, 1.0]]) * 1e-3
    before, after = TimedPose(0.0, 0.0, 0.0, 0.0), TimedPose(1.0, 0.3, 0.0, 0.0, grown)
    first, second = (pose_between(before, after, t) for t in sorted((one, other)))
    added = second.covariance - carried(first.covariance, first, second)
    assert np.linalg.eigvalsh(added)[0] > -1e-12
    rest = after.covariance - carried(second.covariance, second, after)
    assert np.linalg.eigvalsh(rest)[0] > -1e-12


def test_rounding_of_steps_does_not_add_up() -> None:
    """Of a slow robot, or fast images, it would be the same in each step."""
    start = last = reached = TimedPose(0.0, 0.0, 0.0, 0.0)
    sums = np.zeros(3)
    for k in range(1, 1001):
        pose = TimedPose(k / 30.0, k * 1.2345e-3, 0.0, k * 3.3e-6)
        step, reached = rounded(step_between("s", last, pose), reached, pose)
        assert [step.dx, step.dy, step.dphi] == [round(v, 5) for v in (step.dx, step.dy, step.dphi)]
        sums, last = sums + np.array([step.dx, step.dy, step.dphi]), pose
    assert sums[2] == pytest.approx(last.theta - start.theta, abs=1e-5)
    assert [reached.x, reached.y] == pytest.approx([last.x, last.y], abs=1e-5)
