"""Alignment of fixed scanners: exact poses back from hand-measured ones, and honest covariances."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from redetect.groundtruth.commands.lasers import perform_lasers
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.acquisition import load_session
from redetect.groundtruth.lasers.alignment import STEPS, align_scanners
from redetect.groundtruth.lasers.scanners import (
    Scanner,
    Scans,
    read_scanners,
    with_measured_noise,
)
from redetect.groundtruth.lasers.walls import MapProblem, averaged_scan, wall_curves
from redetect.groundtruth.options import Lasers
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
    scans_of,
    write_session,
)
from tools.simulator.laser.session_files import write_building, write_scans

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
    return [scans_of(one, walls, rng, count) for one in scanners]


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
    assert perform_lasers(Lasers(tmp_path)) == 0
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
    empty = scans_of(one, walls, rng)
    found = align_scanners(by_hand((one,), SHIFTS[:1]), [empty], walls)
    assert found.undetermined == ("corridor",)
    error = found.scanners[0].pose - one.pose
    assert abs(error[1]) < 0.005
    assert abs(wrap_angle(error[2])) < 0.002
    # Along the corridor it stays near where it was measured, and says that it does not know.
    assert error[0] == pytest.approx(0.07, abs=0.06)
    assert found.scanners[0].covariance[0, 0] > 0.05**2


def ring(count: int, radius_m: float = 4.0) -> FloatArray:
    """(count, 4) chords of a circle, not at the angles of another ring's."""
    angles = 0.1 + np.linspace(0.0, 2.0 * np.pi, count + 1)
    corners = radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.hstack([corners[:-1], corners[1:]])


@pytest.mark.parametrize("chords", [100, 36])
def test_a_round_room_leaves_a_turn_open(chords: int) -> None:
    """Where the drawing's chords meet are no features, whether they are fine or off by 15 mm."""
    walls = ring(2000)
    one = scanner("round", np.array([1.5, 1.0, 0.2]))
    rng = np.random.default_rng(4)
    empty = scans_of(one, walls, rng)
    for shift in (*SHIFTS, 3.0 * SHIFTS[0]):
        found = align_scanners(by_hand((one,), shift[None]), [empty], ring(chords))
        assert found.undetermined == ("round",)
        error = found.scanners[0].pose - one.pose
        assert error @ np.linalg.solve(found.scanners[0].covariance, error) < 20.0
        # The distance from the centre is determined.
        across = np.array([1.5, 1.0]) @ error[:2] / np.hypot(1.5, 1.0)
        assert abs(across) < 0.01


def test_what_few_readings_determine_is_undetermined() -> None:
    """A niche of 4 cm that a scanner hardly sees may match readings at the wrong place, too."""
    walls = np.array(
        [
            [-30.0, 0.0, 3.0, 0.0], [3.0, 0.0, 3.0, -0.04], [3.0, -0.04, 3.2, -0.04],
            [3.2, -0.04, 3.2, 0.0], [3.2, 0.0, 30.0, 0.0], [-30.0, 4.1, 30.0, 4.1],
        ]
    )  # fmt: skip
    one = scanner("corridor", np.array([0.0, 1.0, 0.2]), max_range_m=30.0)
    for seed in (7, 8, 11):
        rng = np.random.default_rng(seed)
        scans = scans_of(one, walls, rng)
        stated = replace(one, covariance=np.diag([0.04, 0.04, 0.01]))
        stated = replace(stated, pose=one.pose + rng.normal(0.0, [0.2, 0.2, 0.1]))
        found = align_scanners([stated], [scans], walls).scanners[0]
        error = found.pose - one.pose
        assert error @ np.linalg.solve(found.covariance, error) < 16.0


def test_walls_drawn_slightly_askew_do_not_move_a_scanner_along_a_corridor() -> None:
    """Where walls that are parallel were drawn as a wedge, some other place fits exactly."""
    walls = np.array([[-30.0, 0.0, 30.0, 0.0], [-30.0, 3.0, 30.0, 3.0]])
    drawn = walls + np.array([[0.0, 0.01, 0.0, -0.01], [0.0, 0.0, 0.0, 0.02]])
    one = scanner("corridor", np.array([0.0, 1.0, 0.2]), max_range_m=12.0)
    rng = np.random.default_rng(4)
    empty = scans_of(one, walls, rng)
    found = align_scanners(by_hand((one,), SHIFTS[:1]), [empty], drawn)
    assert found.undetermined == ("corridor",)
    assert not found.inconsistent
    error = found.scanners[0].pose - one.pose
    assert error @ np.linalg.solve(found.scanners[0].covariance, error) < 20.0


def test_a_lone_scanner_between_two_walls_cannot_tell_whether_they_are_off() -> None:
    """Between walls at 2 degrees, a centimetre of the drawing is half a metre along them."""
    wide_m = 30.0 * np.tan(np.radians(2.0))
    walls = np.array([[-30.0, 0.0, 30.0, 0.0], [-30.0, 3.0 + wide_m, 30.0, 3.0 - wide_m]])
    one = scanner("wedge", np.array([0.5, 1.2, 0.2]), max_range_m=12.0)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        scans = scans_of(one, walls, rng, 20)
        drawn = walls + rng.normal(0.0, 0.01, walls.shape)
        stated = by_hand((one,), SHIFTS[seed : seed + 1])
        found = align_scanners(stated, [scans], drawn)
        assert found.undetermined == ("wedge",)
        error = found.scanners[0].pose - one.pose
        assert error @ np.linalg.solve(found.scanners[0].covariance, error) < 16.0


def test_a_lone_scanner_notices_that_the_drawing_is_off() -> None:
    """Its few walls could be fitted to a millimetre, by rejecting what contradicts."""
    lone = (four_scanners()[0],)
    squared = []
    for seed in range(8):
        drawn = ROOM + np.random.default_rng(seed).normal(0.0, 0.02, ROOM.shape)
        found = align_scanners(by_hand(lone, SHIFTS[:1]), empty_scans(lone, 300 + seed), drawn)
        assert found.map_sigma_m > 0.002
        error = found.scanners[0].pose - lone[0].pose
        squared.append(error @ np.linalg.solve(found.scanners[0].covariance, error) / 3.0)
    assert float(np.mean(squared)) < 2.5


def test_a_still_scan_leaves_out_what_moves() -> None:
    one = four_scanners()[0]
    empty = empty_scans((one,), 5)[0]
    ranges = empty.ranges_mm.copy()
    ranges[:20, 90] = 500  # somebody passed
    ranges[:, 30] = np.where(np.arange(len(ranges)) % 2, 1000, 3000)  # an edge
    ranges[:120, 60] = 0  # mostly nothing
    scan = averaged_scan(one, ranges)
    assert len(scan.points) == one.readings - 2
    clean = averaged_scan(one, empty.ranges_mm)
    beam = int(np.argmin(np.abs(np.arctan2(*clean.direction.T[::-1]))))
    kept = int(np.argmin(np.abs(np.arctan2(*scan.direction.T[::-1]))))
    assert scan.range_m[kept] == pytest.approx(clean.range_m[beam], abs=0.003)
    nothing = Scans(empty.times_s, np.zeros_like(ranges))
    with pytest.raises(GroundTruthError, match="10 or more"):
        align_scanners((one,), [nothing], ROOM)


def test_bad_input_is_said() -> None:
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
        perform_lasers(Lasers(tmp_path))
    write_building(tmp_path / "building.csv", ROOM)
    assert perform_lasers(Lasers(tmp_path)) == 0
    first = (tmp_path / "aligned.json").read_bytes(), (tmp_path / "aligned.png").read_bytes()
    found = read_scanners(tmp_path / "aligned.json")
    for one, exact in zip(found, scanners):
        assert one.pose[:2] == pytest.approx(exact.pose[:2], abs=1e-3)
        assert wrap_angle(one.pose[2] - exact.pose[2]) == pytest.approx(0.0, abs=1e-3)
    content = json.loads(first[0])
    assert list(content["steps"]) == list(STEPS)
    with pytest.raises(FileExistsError):
        perform_lasers(Lasers(tmp_path))
    assert perform_lasers(Lasers(tmp_path, force=True)) == 0
    again = (tmp_path / "aligned.json").read_bytes(), (tmp_path / "aligned.png").read_bytes()
    assert first == again


def test_a_drawing_that_is_centimetres_off_is_noticed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Single scanners would fit it to a millimetre, tens of millimetres off."""
    scanners = four_scanners()
    squared = []
    for seed in range(4):
        drawn = ROOM + np.random.default_rng(seed).normal(0.0, 0.02, ROOM.shape)
        found = align_scanners(by_hand(scanners), furnished(scanners, 200 + seed, 40), drawn)
        assert found.map_sigma_m > 0.004
        error = np.stack([one.pose for one in found.scanners])
        error -= np.stack([one.pose for one in scanners])
        error[:, 2] = wrap_angle(error[:, 2])
        squared += [
            float(e @ np.linalg.solve(one.covariance, e) / 3.0)
            for e, one in zip(error, found.scanners)
        ]
        # The shape of the body is that of their mutual alignment.
        apart = error[:, :2] - error[:, :2].mean(axis=0)
        assert np.abs(apart).max() < 0.05
        # And their errors are common, which the joint covariance says.
        joint = found.covariance
        common = joint[0, 3] / np.sqrt(joint[0, 0] * joint[3, 3])
        assert common > 0.3
    assert float(np.mean(squared)) < 2.5

    write_session(
        tmp_path, by_hand(scanners), record(scanners, circle, (0.0, 0.05), FRONTED, 6), FRONTED
    )
    for one, empty in zip(scanners, empty_scans(scanners, 8)):
        write_scans(tmp_path / "empty" / f"{one.name}.scans.npz", empty, overwrite=True)
    write_building(tmp_path / "building.csv", drawn)
    assert perform_lasers(Lasers(tmp_path)) == 0
    assert "the walls are off the map by some" in capsys.readouterr().err
    write_building(tmp_path / "building.csv", 1000.0 * ROOM, overwrite=True)
    assert perform_lasers(Lasers(tmp_path, output=tmp_path / "other.json")) == 0
    assert "of its readings lie on walls of" in capsys.readouterr().err
    _, _, fixed, *_ = load_session(tmp_path, tmp_path / "aligned.json")
    assert fixed.covariance.shape == (12, 12)
    assert fixed.covariance[0, 3] != 0.0


def test_places_alike_are_told_apart_in_the_coordinates_of_a_country() -> None:
    """A corridor with equal recesses: three metres are three metres, far from the origin, too."""
    along = np.array([1.0, 0.0, 1.0, 0.0])
    recess = np.array([[0.0, 2, 1, 2], [1, 2, 1, 3], [1, 3, 2, 3], [2, 3, 2, 2], [2, 2, 3, 2]])
    walls = np.concatenate([recess + x * along for x in np.arange(-30.0, 30.0, 3.0)])
    walls = np.vstack([walls, [[-30.0, 0.0, 30.0, 0.0]]])
    one = replace(
        scanner("a", np.array([0.4, 1.0, 0.5]), 0.01, 6.0), covariance=np.diag([4.0, 0.01, 0.01])
    )
    seen = averaged_scan(one, ranges_mm(one, walls)[None])
    spreads = []
    for x in (0.0, 450_000.0):
        pose, there = one.pose + x * np.eye(3)[0], walls + x * along
        prior = np.asarray(np.linalg.inv(one.covariance))
        problem = MapProblem([seen], pose[None], prior, there, wall_curves(there))
        _, others = problem.likely_pose(pose, [0.2, 0.1, 0.05, 0.02])
        spreads.append(others[0, 0])
    assert spreads[0] > 1.0
    assert spreads[1] == pytest.approx(spreads[0], rel=0.01)


def test_an_exact_drawing_stays_exact() -> None:
    scanners = four_scanners()
    found = align_scanners(by_hand(scanners), furnished(scanners, 3), ROOM)
    assert found.map_sigma_m == 0.0


def test_noise_is_measured_where_it_is_far_larger_than_stated() -> None:
    true, stated = four_scanners(0.01), four_scanners(0.002)
    empties = empty_scans(true, 5)
    found, texts = with_measured_noise(stated, empties, "scanners.json")
    for one in found:
        assert one.sigma_m == pytest.approx(0.0104, rel=0.1)
    assert with_measured_noise(true, empties, "scanners.json") == (true, [])
    assert len(texts) == 4
    assert "not by 2.0 mm as in scanners.json" in texts[0]
