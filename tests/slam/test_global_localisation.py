"""A robot that wakes up somewhere: where is found where it is certain, and nowhere else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle
from redetect.landmarks.map_file import read_path
from redetect.plane import apply, compose, invert
from redetect.slam.association.registration import localise_globally
from redetect.slam.cli import main
from redetect.slam.recording import LineRows, Recording
from tests.slam.ekf_rows import circle_rows

SIGMA_M = 0.05
STEP = np.array([0.0, -0.25, 0.05])
STEP_SIGMA = np.array([0.01, 0.02, 0.01])


def drive(
    disc_xy: FloatArray,
    start: FloatArray,
    seed: int,
    steps: int = 40,
    clutter_rows: float = 0.1,
    slower: int = 1,
    bias_sigmas: FloatArray | float = 0.0,
) -> Recording:
    """Discs within 4 m, noisy, and rows of nothing in some frames; the odometry errs as it says.

    A `slower` robot takes that many steps for each. All steps err by `bias_sigmas` besides.
    """
    step, step_sigma = STEP / slower, STEP_SIGMA / np.sqrt(slower)
    steps *= slower
    rng = np.random.default_rng(seed)
    measured = step + step_sigma * (bias_sigmas + rng.standard_normal((steps, 3)))
    pose, rows = start, []
    for k in range(steps):
        pose = compose(pose, step)
        seen = apply(invert(pose), disc_xy)
        near = seen[(np.hypot(*seen.T) < 4.0) & (seen[:, 1] < -0.5)]
        clutter = rng.uniform([-3.0, -4.0], [3.0, -1.0], (int(rng.random() < clutter_rows), 2))
        for xy in (*(near + SIGMA_M * rng.standard_normal(near.shape)), *clutter):
            rows.append((k, xy))
    return Recording(
        tuple(f"f{k}" for k in range(steps)),
        measured,
        np.tile(np.diag(step_sigma**2), (steps, 1, 1)),
        circle_rows((k, xy, SIGMA_M**2 * np.eye(2), -1) for k, xy in rows),
        LineRows.of(),
    )


def test_the_pose_is_found_in_a_large_map() -> None:
    squares = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        disc_xy = rng.uniform(0.0, [40.0, 30.0], (300, 2))
        start = np.array([*rng.uniform([5.0, 5.0], [35.0, 25.0]), rng.uniform(-3.0, 3.0)])
        located = localise_globally(drive(disc_xy, start, seed), disc_xy)
        assert located is not None
        off = compose(invert(start), located.pose)
        assert np.hypot(off[0], off[1]) < 0.5
        assert abs(off[2]) < 0.15
        difference = located.pose - start
        difference[2] = off[2]
        squares.append(difference @ np.linalg.solve(located.covariance, difference) / 3.0)
        assert located.agreeing >= 0.5 * located.discs
    assert 0.05 < np.mean(squares) < 1.5


def test_the_pose_is_found_among_more_clutter_than_discs() -> None:
    """A slow robot sees a disc dozens of times, and rows of nothing at another place each time."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        disc_xy = rng.uniform(0.0, 15.0, (60, 2))
        start = np.array([*rng.uniform(4.0, 11.0, 2), rng.uniform(-3.0, 3.0)])
        seen = drive(disc_xy, start, seed, clutter_rows=0.7, slower=5)
        located = localise_globally(seen, disc_xy)
        assert located is not None
        off = compose(invert(start), located.pose)
        assert np.hypot(off[0], off[1]) < 0.4
        assert located.agreeing > 0.6 * located.discs


def test_systematic_errors_of_odometry_are_in_the_covariance_of_the_start() -> None:
    squares = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        disc_xy = rng.uniform(0.0, 20.0, (160, 2))
        start = np.array([*rng.uniform(6.0, 14.0, 2), rng.uniform(-3.0, 3.0)])
        bias = 1.5 * np.array([0.0, *rng.choice([-1.0, 1.0], 2)])
        located = localise_globally(drive(disc_xy, start, seed, bias_sigmas=bias), disc_xy)
        assert located is not None
        difference = located.pose - start
        difference[2] = wrap_angle(difference[2])
        squares.append(difference @ np.linalg.solve(located.covariance, difference) / 3.0)
    assert np.mean(squares) < 1.1


def test_where_the_building_repeats_itself_nothing_is_certain() -> None:
    rng = np.random.default_rng(1)
    room = rng.uniform(0.0, 7.0, (25, 2))
    disc_xy = np.concatenate([room, room + np.array([20.0, 0.0])])
    seen = drive(disc_xy, np.array([3.0, 5.0, 0.3]), 1, steps=10)
    assert localise_globally(seen, disc_xy) is None
    one = localise_globally(drive(room, np.array([3.0, 5.0, 0.3]), 1, steps=10), room)
    assert one is not None
    np.testing.assert_allclose(one.pose, [3.0, 5.0, 0.3], atol=0.4)


@pytest.mark.parametrize("pairs", [6, 12])
def test_a_corridor_of_regular_pairs_looks_alike_a_period_on_and_from_its_other_end(
    pairs: int,
) -> None:
    """All its discs are in both places: none is left beside those that agree."""
    along = np.repeat(-1.5 * np.arange(pairs), 2)
    disc_xy = np.column_stack([np.tile([-1.2, 1.2], pairs), along])
    for seed, ahead in enumerate((1.0, -0.8, -2.0)):
        seen = drive(disc_xy, np.array([0.3, ahead, 0.0]), seed)
        assert localise_globally(seen, disc_xy) is None


def test_another_building_has_no_place_for_it() -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        here, there = rng.uniform(0.0, 30.0, (2, 250, 2))
        assert localise_globally(drive(here, np.array([15.0, 15.0, 0.0]), seed), there) is None


@pytest.mark.parametrize("count", [0, 4])
def test_few_discs_are_no_place(count: int) -> None:
    disc_xy = np.random.default_rng(2).uniform(0.0, 5.0, (count, 2))
    assert localise_globally(drive(disc_xy, np.zeros(3), 2), disc_xy) is None


@pytest.mark.long
def test_a_run_is_localised_from_an_unknown_start(
    project_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The demo run from its 25th frame on, without identifiers, in the map of the whole."""
    run = project_root / "images" / "e"
    assert main(["map", str(run), "-o", str(tmp_path / "map")]) == 0
    head, *steps = (run / "map.circles").read_text().split("STEP ")
    rest = [
        "\n".join(
            " ".join([*line.split()[:7], "-1"]) if line.startswith("LANDMARK_C") else line
            for line in step.splitlines()
        )
        for step in steps[25:]
    ]
    part = tmp_path / "part.circles"
    part.write_text(head + "".join(f"STEP {step}\n" for step in rest))
    where = ["--map", str(tmp_path / "map" / "map.csv"), "--association", "joint"]
    assert main(["localize", str(part), *where, "--lost", "-o", str(tmp_path / "out")]) == 0
    assert "located at" in capsys.readouterr().out
    found = read_path(tmp_path / "out" / "path.csv").poses[1:]
    true = read_path(tmp_path / "map" / "path.csv").poses[26:]
    off = np.hypot(*(found[:, :2] - true[:, :2]).T)
    assert np.median(off) < 0.15
    assert main(["localize", str(part), *where, "--lost", "--start", "1", "0", "0"]) == 1
    assert "expected one of them" in capsys.readouterr().err
