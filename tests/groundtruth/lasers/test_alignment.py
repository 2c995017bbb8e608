"""Alignment of fixed scanners: exact poses back from hand-measured ones, and honest covariances."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from redetect.groundtruth.commands.lasers import perform
from redetect.groundtruth.commands.options import Lasers
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.alignment import (
    STEPS,
    align_scanners,
    still_scan,
)
from redetect.groundtruth.lasers.scanners import Scanner, Scans, read_scanners
from redetect.groundtruth.settings import AlignmentSettings
from redetect.landmarks import wrap_angle
from redetect.plane import between
from tests.groundtruth.lasers.scene import (
    FRONTED,
    ROOM,
    circle,
    empty_scans,
    four_scanners,
    ranges_mm,
    record,
    scanner,
    write_session,
)
from tools.simulator.laser.writers import write_building, write_scans

FloatArray = NDArray[np.float64]

SHIFTS = np.array(
    [[0.07, -0.06, 0.05], [-0.08, 0.05, -0.045], [0.05, 0.08, 0.04], [-0.06, -0.07, -0.05]]
)


def by_hand(scanners: tuple[Scanner, ...], shifts: FloatArray = SHIFTS) -> tuple[Scanner, ...]:
    sigma = np.diag([0.0025, 0.0025, 0.0012])
    return tuple(
        replace(one, pose=one.pose + shift, covariance=sigma)
        for one, shift in zip(scanners, shifts)
    )


def furnished(scanners: tuple[Scanner, ...], seed: int, count: int = 100) -> list[Scans]:
    """The empty room with a cupboard and a box that no map shows."""
    rng = np.random.default_rng(seed)
    things = [[2.0, 5.6, 2.0, 6.0], [2.0, 5.6, 3.0, 5.6], [3.0, 5.6, 3.0, 6.0]]
    things += [[7.4, 0.0, 7.4, 0.5], [7.4, 0.5, 8.0, 0.5]]
    walls = np.vstack([ROOM, np.array(things)])
    return [
        Scans(np.arange(count) / 75.0, np.stack([ranges_mm(s, walls, rng) for _ in range(count)]))
        for s in scanners
    ]


def test_exact_poses_come_back_from_measured_ones() -> None:
    """0.1 m and 3 degrees off, with furniture that is not in the map."""
    scanners = four_scanners()
    found = align_scanners(by_hand(scanners), furnished(scanners, 1), ROOM)
    truth = np.stack([one.pose for one in scanners])
    for name, worst_m in zip(STEPS, (0.1, 0.1, 0.1, 0.05, 0.05, 0.002)):
        poses = found.steps[name]
        error = between(poses[0], poses[1:]) - between(truth[0], truth[1:])
        assert np.hypot(error[:, 0], error[:, 1]).max() < worst_m, name
    error = np.stack([one.pose for one in found.scanners]) - truth
    assert np.abs(error[:, :2]).max() < 0.001
    assert np.degrees(np.abs(wrap_angle(error[:, 2])).max()) < 0.02
    assert not found.undetermined
    assert not found.inconsistent
    assert found.rms_m.max() < 0.003


@pytest.mark.long
def test_covariances_are_right() -> None:
    scanners = four_scanners()
    squared = []
    for seed in range(5):
        shifts = np.random.default_rng(seed).normal(0.0, [0.03, 0.03, 0.02], (4, 3))
        found = align_scanners(by_hand(scanners, shifts), furnished(scanners, 100 + seed, 40), ROOM)
        for one, exact in zip(found.scanners, scanners):
            error = one.pose - exact.pose
            error[2] = wrap_angle(error[2])
            squared.append(error @ np.linalg.solve(one.covariance, error) / 3.0)
    # 20 draws: 3 sigma of their mean is 0.55; the floor on readings makes it rather too small.
    assert 0.45 < float(np.mean(squared)) < 1.55


@pytest.mark.long
def test_a_scanner_measured_far_off_is_found_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half a metre and 8 degrees off: five times what its sigma says."""
    scanners = four_scanners()
    shifts = 0.5 * SHIFTS
    shifts[2] = [0.4, -0.3, 0.15]
    write_session(
        tmp_path, by_hand(scanners, shifts), record(scanners, circle, (0.0, 0.05), FRONTED, 6),
        FRONTED,
    )  # fmt: skip
    for one, empty in zip(scanners, empty_scans(scanners, 8)):
        write_scans(tmp_path / "empty" / f"{one.name}.scans.npz", empty, overwrite=True)
    write_building(tmp_path / "building.csv", ROOM)
    assert perform(Lasers(tmp_path)) == 0
    content = json.loads((tmp_path / "aligned.json").read_text())
    assert content["far_off_measured"] == ["fixed2"]
    assert "fixed2: was measured wrong" in capsys.readouterr().err
    found = read_scanners(tmp_path / "aligned.json")[2]
    assert found.pose[:2] == pytest.approx(scanners[2].pose[:2], abs=1e-3)


def test_one_scanner_alone() -> None:
    lone = (four_scanners()[0],)
    found = align_scanners(by_hand(lone, SHIFTS[:1]), empty_scans(lone, 3), ROOM)
    assert found.scanners[0].pose == pytest.approx(lone[0].pose, abs=1e-3)


def test_a_corridor_leaves_a_direction_open() -> None:
    walls = np.array([[-30.0, 0.0, 30.0, 0.0], [-30.0, 3.0, 30.0, 3.0]])
    one = scanner("corridor", np.array([0.0, 1.0, 0.2]), max_range_m=12.0)
    rng = np.random.default_rng(4)
    empty = Scans(np.arange(50) / 75.0, np.stack([ranges_mm(one, walls, rng) for _ in range(50)]))
    found = align_scanners(by_hand((one,), SHIFTS[:1]), [empty], walls)
    assert found.undetermined == ("corridor",)
    error = found.scanners[0].pose - one.pose
    assert abs(error[1]) < 0.005
    assert abs(wrap_angle(error[2])) < 0.002
    # Along the corridor it stays near where it was measured, and says that it does not know.
    assert error[0] == pytest.approx(0.07, abs=0.06)
    assert found.scanners[0].covariance[0, 0] > 0.05**2


def test_a_still_scan_leaves_out_what_moves() -> None:
    one = four_scanners()[0]
    empty = empty_scans((one,), 5)[0]
    ranges = empty.ranges_mm.copy()
    ranges[:20, 90] = 500  # somebody passed
    ranges[:, 30] = np.where(np.arange(len(ranges)) % 2, 1000, 3000)  # an edge
    ranges[:120, 60] = 0  # mostly nothing
    scan = still_scan(one, ranges)
    assert len(scan.points) == one.readings - 2
    clean = still_scan(one, empty.ranges_mm)
    beam = int(np.argmin(np.abs(np.arctan2(*clean.direction.T[::-1]))))
    kept = int(np.argmin(np.abs(np.arctan2(*scan.direction.T[::-1]))))
    assert scan.range_m[kept] == pytest.approx(clean.range_m[beam], abs=0.003)
    nothing = Scans(empty.times_s, np.zeros_like(ranges))
    with pytest.raises(GroundTruthError, match="10 or more"):
        align_scanners((one,), [nothing], ROOM)


def test_bad_input_is_said() -> None:
    with pytest.raises(GroundTruthError, match="no scanners"):
        align_scanners([], [], ROOM)
    with pytest.raises(GroundTruthError, match="gate_m"):
        AlignmentSettings(gate_m=-1.0)
    with pytest.raises(GroundTruthError, match="keep"):
        AlignmentSettings(keep=0.0)


@pytest.mark.long
def test_the_command(tmp_path: Path) -> None:
    scanners = four_scanners()
    scans = record(scanners, circle, (0.0, 0.1), FRONTED, 6)
    write_session(tmp_path, by_hand(scanners), scans, FRONTED)
    # The session's empty scans are from where the scanners stand in truth.
    for one, empty in zip(scanners, empty_scans(scanners, 8)):
        write_scans(tmp_path / "empty" / f"{one.name}.scans.npz", empty, overwrite=True)
    with pytest.raises(GroundTruthError, match="building"):
        perform(Lasers(tmp_path))
    write_building(tmp_path / "building.csv", ROOM)
    assert perform(Lasers(tmp_path)) == 0
    first = (tmp_path / "aligned.json").read_bytes(), (tmp_path / "aligned.png").read_bytes()
    found = read_scanners(tmp_path / "aligned.json")
    for one, exact in zip(found, scanners):
        assert one.pose[:2] == pytest.approx(exact.pose[:2], abs=1e-3)
        assert wrap_angle(one.pose[2] - exact.pose[2]) == pytest.approx(0.0, abs=1e-3)
    content = json.loads(first[0])
    assert list(content["steps"]) == list(STEPS)
    with pytest.raises(FileExistsError):
        perform(Lasers(tmp_path))
    assert perform(Lasers(tmp_path, force=True)) == 0
    again = (tmp_path / "aligned.json").read_bytes(), (tmp_path / "aligned.png").read_bytes()
    assert first == again
