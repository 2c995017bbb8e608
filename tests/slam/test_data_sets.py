"""Excerpts in the formats of MRCLAM and of Victoria Park, whose truth is known: read and used."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle
from redetect.landmarks.map_file import read_map, read_path
from redetect.plane import chain_steps
from redetect.slam.cli import main
from redetect.slam.formats.ranges import discs_of_ranges
from redetect.slam.formats.utias import read_run
from redetect.slam.formats.victoria_park import trees_of
from redetect.slam.recording import read_recording

RANGE_SIGMA, BEARING_SIGMA = 0.05, 0.01
LAG_S, SPEED, TURN, DEPTH = 0.3, 1.05, 0.97, 1.05


@pytest.fixture(scope="module")
def utias(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Robot 1 drives three rounds among 15 landmarks and sees what is before it.

    As in the real logs, odometry consists of commands, which the robot follows later and not
    exactly, with short zeros at full seconds; "ranges" are depths, and too long.
    """
    folder = tmp_path_factory.mktemp("utias")
    rng = np.random.default_rng(1)
    landmarks = rng.uniform([-3.5, -3.5], [3.5, 3.5], (15, 2))
    period, count, late = 0.05, 2400, round(LAG_S / 0.05)
    time = 1248272000.0 + period * np.arange(count + 1)
    turn = np.where(np.arange(count) // 70 % 2, -0.2, 0.48) + 0.01 * rng.standard_normal(count)
    command = np.stack([0.3 + 0.01 * rng.standard_normal(count), turn], axis=1)
    motion = np.concatenate([np.zeros((late, 2)), command[:-late]]) * [SPEED, TURN]
    half = 0.5 * motion[:, 1] * period
    chord = motion[:, 0] * period * np.sinc(half / np.pi)
    along = np.stack([chord * np.cos(half), chord * np.sin(half), 2 * half], axis=1)
    poses = chain_steps(along, (0.0, -2.0, 0.1))
    odometry, truth, seen = [], [], []
    for k, pose in enumerate(poses):
        truth.append(f"{time[k]:.3f}    {pose[0]:.6f} {pose[1]:.6f} {wrap_angle(pose[2]):.6f}")
        if k < count:
            if k and k % 20 == 0:
                odometry.append(f"{time[k] - 0.02:.3f}\t0.000\t0.000")
            odometry.append(f"{time[k]:.3f}\t{command[k, 0]:.3f}\t{command[k, 1]:.3f}")
        if k == 0 or k % 10:
            continue
        offset = landmarks - pose[:2]
        reach = np.hypot(*offset.T)
        bearing = wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - pose[2])
        for i in np.flatnonzero((np.abs(bearing) < 0.8) & (reach < 5.0)):
            depth = (reach[i] + RANGE_SIGMA * rng.standard_normal()) * np.cos(bearing[i])
            b = bearing[i] + BEARING_SIGMA * rng.standard_normal()
            seen.append(f"{time[k]:.3f}\t{100 + i}\t{DEPTH * depth:.3f}\t{b:.3f}")
        seen.append(f"{time[k]:.3f}\t14\t1.000\t0.100")  # another robot
    barcodes = [f"{n + 1} {(5, 14, 41, 32, 23)[n]}" for n in range(5)]
    barcodes += [f"{6 + i} {100 + i}" for i in range(15)]
    places = [f"{6 + i} {x:.8f} {y:.8f} 0.0001 0.0002" for i, (x, y) in enumerate(landmarks)]
    for name, rows in (
        ("Robot1_Odometry", odometry),
        ("Robot1_Measurement", seen),
        ("Robot1_Groundtruth", truth),
        ("Barcodes", barcodes),
        ("Landmark_Groundtruth", places),
    ):
        head = [
            "# UTIAS Multi-Robot Cooperative Localization and Mapping Dataset",
            "# Time [s] ...",
        ]
        (folder / f"{name}.dat").write_text("\n".join([*head, *rows]) + "\n")
    sigmas = ["--range-sigma", str(RANGE_SIGMA), "--bearing-sigma", str(BEARING_SIGMA)]
    robot = str(folder / "Robot1_Odometry.dat")
    assert main(["import", robot, "-o", str(folder / "run.circles"), *sigmas]) == 0
    assert main(["import", robot, "-o", str(folder / "true.csv")]) == 0
    places_file = str(folder / "Landmark_Groundtruth.dat")
    assert main(["import", places_file, "-o", str(folder / "true_map.csv")]) == 0
    return folder


def test_the_response_of_a_robot_to_its_commands_is_found(
    utias: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, found, _ = read_run(utias / "Robot1_Odometry.dat")
    assert found is not None
    assert abs(found.lag_s - LAG_S) < 0.02
    assert abs(found.speed - SPEED) < 0.01
    assert abs(found.turn - TURN) < 0.01
    assert abs(found.depth - DEPTH) < 0.004
    true = read_path(utias / "true.csv").poses
    raw, *learned = read_run(utias / "Robot1_Odometry.dat", calibrated=False)
    assert learned == [None, None]
    distance, depth = (np.hypot(*run.circles.xy.T) for run in (recording, raw))
    bearing = np.arctan2(raw.circles.xy[:, 0], -raw.circles.xy[:, 1])
    # Rows are linearised near the landmark, not at its bearing as measured.
    np.testing.assert_allclose(distance * found.depth * np.cos(bearing), depth, rtol=2e-3)
    off = [
        np.abs(wrap_angle(chain_steps(run.steps, true[0])[:, 2] - true[:, 2])).max()
        for run in (recording, raw)
    ]
    assert off[0] < 0.1 < 0.3 < off[1]
    odometry = str(utias / "Robot1_Odometry.dat")
    target = str(utias / "calibrated.circles")
    assert main(["import", odometry, "-o", target]) == 0
    assert f"is taken to move {found.lag_s:.2f} s after its commands" in capsys.readouterr().out
    assert f"# {found.sentence()}\n" in Path(target).read_text()


def test_without_known_landmarks_depths_are_too_long_by_the_usual_factor(
    utias: Path, tmp_path: Path
) -> None:
    """The scale of a map is unknown then, however long the log is."""
    for file in utias.glob("*.dat"):
        if "Landmark" not in file.name:
            shutil.copy(file, tmp_path)
    _, found, _ = read_run(tmp_path / "Robot1_Odometry.dat")
    assert found is not None
    assert abs(found.depth - 1.033) < 0.005
    assert abs(found.speed / found.depth - SPEED / DEPTH) < 0.03


@pytest.mark.parametrize(
    ("late_s", "times", "told"),
    [
        (2.0, 1.0, ("clocks of odometry and measurements differ", "rows contradict the others")),
        (0.0, 1000.0, ("times as large as usual: are clocks, units and signs",)),
        (0.0, 1.0, ()),
    ],
)
def test_clocks_and_units_that_cannot_be_right_are_told(
    late_s: float, times: float, told: tuple[str, ...], utias: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    shutil.copytree(utias, tmp_path, dirs_exist_ok=True)
    seen = tmp_path / "Robot1_Measurement.dat"
    rows = np.loadtxt(seen) * [1.0, 1.0, times, 1.0] + [late_s, 0.0, 0.0, 0.0]
    np.savetxt(seen, rows, fmt=("%.3f", "%d", "%.3f", "%.3f"))
    log = str(tmp_path / "Robot1_Odometry.dat")
    assert main(["import", log, "-o", str(tmp_path / "again.circles")]) == 0
    said = capsys.readouterr().err
    assert said.count("warning: ") == len(told)
    assert all(words in said for words in told)


def test_a_robot_that_shows_nothing_of_its_response_has_the_usual_one(tmp_path: Path) -> None:
    for name, rows in (
        ("Robot1_Odometry", "4 0 0\n6 0 0\n"),
        ("Robot1_Measurement", "5 100 1 0\n5.5 100 1 0\n"),
        ("Barcodes", "6 100\n"),
    ):
        (tmp_path / f"{name}.dat").write_text(rows)
    found = read_run(tmp_path / "Robot1_Odometry.dat")[1]
    assert found is not None
    np.testing.assert_allclose(found, (0.25, 1.0, 1.0, 1.033), atol=0.06)


def test_movements_in_a_gap_of_the_log_and_changes_of_motion_are_uncertain(
    utias: Path, tmp_path: Path
) -> None:
    shutil.copytree(utias, tmp_path, dirs_exist_ok=True)
    log = tmp_path / "Robot1_Odometry.dat"
    rows = log.read_text().splitlines()
    log.write_text("\n".join(rows[:1000] + rows[1035:]) + "\n")  # 1.75 s
    odometry = str(log)
    assert main(["import", odometry, "-o", str(tmp_path / "run.circles"), "--force"]) == 0
    lines = (tmp_path / "run.circles").read_text().splitlines()
    sigma = np.sqrt([float(line.split()[10]) for line in lines if line.startswith("STEP")])
    assert 3 <= np.count_nonzero(sigma > 0.1) <= 4  # turns vary by 0.33 rad/s
    changes = sigma[(sigma > 0.02) & (sigma < 0.1)]
    assert 20 < len(changes) < 36  # turn rates change 34 times, by 0.66 rad/s within 0.08 s
    assert np.median(changes) == pytest.approx(0.08 * 0.66, abs=0.01)


def _start(folder: Path) -> list[str]:
    return ["--start", *map(str, read_path(folder / "true.csv").poses[0])]


def _off(folder: Path, path: Path) -> float:
    error = read_path(path).poses[:, :2] - read_path(folder / "true.csv").poses[:, :2]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def test_utias_is_mapped(utias: Path) -> None:
    recording = read_recording(utias / "run.circles")
    assert len(recording) == len(read_path(utias / "true.csv").poses) - 1 == 191
    assert set(recording.circles.ids.tolist()) <= set(range(6, 21))
    run = ["map", str(utias / "run.circles"), "-o", str(utias / "map"), *_start(utias)]
    assert main(run) == 0
    assert _off(utias, utias / "map" / "path.csv") < 0.05
    found, true = read_map(utias / "map" / "map.csv").discs, read_map(utias / "true_map.csv").discs
    places = true.xy[np.searchsorted(true.ids, found.ids)]
    assert np.sqrt(np.mean(np.sum((found.xy - places) ** 2, axis=1))) < 0.05


def test_utias_is_filtered_and_localised_in(utias: Path) -> None:
    run, reference = str(utias / "run.circles"), ["--reference", str(utias / "true.csv")]
    common = [*reference, *_start(utias)]
    assert main(["ekf", run, *common, "-o", str(utias / "ekf")]) == 0
    assert _off(utias, utias / "ekf" / "path.csv") < 0.05
    own_map = ["--map", str(utias / "true_map.csv"), "-o", str(utias / "local")]
    assert main(["localize", run, *own_map, *common]) == 0
    assert _off(utias, utias / "local" / "path.csv") < 0.05


def test_utias_is_associated_without_identifiers(utias: Path) -> None:
    target = utias / "found.circles"
    level = ["--tilt-sigma-deg", "0"]  # ranges are measured, not seen on the floor
    assert main(["associate", str(utias / "run.circles"), "-o", str(target), *level]) == 0
    report = json.loads((utias / "found.json").read_text())
    score = report["runs"][0]["scores"]["circles"]["map"]
    assert score["pair_precision"] > 0.99
    assert score["right_rows"] > 0.9


def test_malformed_files_are_refused(utias: Path, capsys: pytest.CaptureFixture[str]) -> None:
    odd = utias / "odd"
    odd.mkdir()
    for name in ("Measurement", "Odometry"):
        text = (utias / f"Robot1_{name}.dat").read_text()
        (odd / f"Robot1_{name}.dat").write_text(text + ("1.0 2.0\n" if name == "Odometry" else ""))
    target = str(odd / "run.circles")
    assert main(["import", str(odd / "Robot1_Odometry.dat"), "-o", target]) == 1
    assert (
        "Robot1_Odometry.dat:2522: '1.0 2.0': expected 3 numbers: time v omega"
        in capsys.readouterr().err
    )
    assert main(["import", str(odd / "Robot1_Measurement.dat"), "-o", target]) == 1
    assert "expected a RobotN_Odometry.dat" in capsys.readouterr().err
    assert main(["import", str(odd / "aa3_dr.mat"), "-o", target]) == 1
    assert "aa3_dr.mat: no such MATLAB file" in capsys.readouterr().err
    (odd / "aa3_dr.mat").write_text("no matrix")
    assert main(["import", str(odd / "aa3_dr.mat"), "-o", target]) == 1
    assert "aa3_dr.mat: cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        (
            "Robot1_Odometry",
            "5 1 0\n3 1 0\n6 1 0\n",
            "Odometry.dat: 3.000 follows 5.000: expected ascending times",
        ),
        (
            "Robot1_Odometry",
            "5000 1 0\n6000 1 0\n",
            "dat: times 5000.000 to 6000.000, Robot1_Measurement.dat: ",
        ),
        (
            "Robot1_Measurement",
            "5 100 1 0\n6 100 -1 0\n",
            "Measurement.dat: range -1 at 6.000: expected above 0",
        ),
        (
            "Robot1_Measurement",
            "5 100 1 0\n6 100 1 3\n",
            "Measurement.dat: bearing 3 at 6.000: expected within +-1.2, as seen by a camera",
        ),
        (
            "Robot1_Measurement",
            "5 100 1e200 0\n",
            "dat: expected numbers within +-1e+24",
        ),
        ("Barcodes", "6 100\n7 100\n", "expected a subject for each barcode"),
        (
            "Robot1_Groundtruth",
            "5 1 0 0\n3 1 0 0\n",
            "truth.dat: 3.000 follows 5.000: expected ascending times",
        ),
        (
            "Robot1_Groundtruth",
            "7000 1 0 0\n8000 1 0 0\n",
            "Robot1_Groundtruth.dat: 7000.000 to 8000.000: expected",
        ),
        ("Robot1_Groundtruth", "5 1 0 0\n5.5 1 0 0\n", None),
        ("Landmark_Groundtruth", "6 1 0 0 0\n6 1 0 0 0\n", "expected landmarks, each once"),
        ("Landmark_Groundtruth", "6.5 1 0 0 0\n", "subject 6.5: expected a whole number"),
        ("Landmark_Groundtruth", "1e20 1 0 0 0\n", "subject 1e+20: expected a whole number"),
        ("Landmark_Groundtruth", "6 1 0 -1 0\n", "and sigmas of 0 or more"),
        ("Barcodes", "6 1e20\n", "Barcodes.dat: barcode 1e+20: expected a whole number"),
        ("Barcodes", "6 5.2\n7 5.1\n", "Barcodes.dat: barcode 5.2: expected a whole number"),
        ("Robot1_Measurement", "5 5.6 1 0\n", "Measurement.dat: barcode 5.6: expected a whole"),
        ("Landmark_Groundtruth", "", "expected landmarks"),
    ],
)
def test_rows_that_contradict_each_other_are_refused(
    name: str, text: str, told: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = {
        "Robot1_Odometry": "4 1 0\n6 1 0\n",
        "Robot1_Measurement": "5 100 1 0\n",
        "Barcodes": "6 100\n",
        "Robot1_Groundtruth": "3 0 0 0\n7 1 0 0\n",
    }
    for each, content in (files | {name: text}).items():
        (tmp_path / f"{each}.dat").write_text(content)
    of_map = name == "Landmark_Groundtruth"
    file, output = (f"{name}.dat", "map.csv") if of_map else ("Robot1_Odometry.dat", "run.circles")
    output = "true.csv" if name == "Robot1_Groundtruth" else output
    code = main(["import", str(tmp_path / file), "-o", str(tmp_path / output)])
    assert code == int(told is not None)
    said = "".join(capsys.readouterr())
    assert (told or "2 poses, 1 of them outside the true ones: the nearest") in said


def test_a_clock_that_is_set_back_a_little_changes_nothing(utias: Path, tmp_path: Path) -> None:
    written, outputs = [], ("again.circles", "again.csv")
    for name, swap in (("sorted", 0), ("set back", 1)):
        folder = tmp_path / name
        shutil.copytree(utias, folder)
        for log in ("Odometry", "Groundtruth"):
            path = folder / f"Robot1_{log}.dat"
            head, rows = path.read_text().split("\n", 1)
            lines = rows.splitlines()
            lines[10], lines[10 + swap] = lines[10 + swap], lines[10]
            path.write_text("\n".join([head, *lines]) + "\n")
        for output in outputs:
            odometry = str(folder / "Robot1_Odometry.dat")
            assert main(["import", odometry, "-o", str(folder / output)]) == 0
        written.append([(folder / output).read_bytes() for output in outputs])
    assert written[0] == written[1]


def scan_of(trees: FloatArray, pose: FloatArray, radius_m: float = 0.25) -> FloatArray:
    """Ranges every half degree to trunks in front of the scanner, in cm as the files have them."""
    angle = np.radians(0.5 * np.arange(361) - 90.0) + pose[2]
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    scan = np.full(361, 81.91)
    for tree in trees:
        offset = tree - pose[:2]
        along = ray @ offset
        square = radius_m**2 - (offset @ offset - along**2)
        hit = (square > 0.0) & (along > 0.0)
        scan[hit] = np.minimum(scan[hit], along[hit] - np.sqrt(square[hit]))
    return 100.0 * scan


def test_victoria_park_is_mapped_from_odometry(tmp_path: Path) -> None:
    """Two rounds of a car among trees; the scanner is ahead of the axle and to the left of it."""
    rng = np.random.default_rng(2)
    period, count, speed, radius = 0.2, 420, 3.0, 20.0
    turn = speed / radius * period
    axle = chain_steps(
        np.tile([speed * period * np.sinc(turn / (2 * np.pi)) * f for f in (1.0, 0.0)] + [turn],
                (count, 1))
        @ np.array([[np.cos(turn / 2), np.sin(turn / 2), 0], [0, 1, 0], [0, 0, 1]])
    )  # fmt: skip
    cos, sin = np.cos(axle[:, 2]), np.sin(axle[:, 2])
    scanner = axle.copy()
    scanner[:, 0] += 3.78 * cos - 0.5 * sin
    scanner[:, 1] += 3.78 * sin + 0.5 * cos
    around = rng.uniform(0.0, 2 * np.pi, 60)
    reach = rng.choice([13.0, 27.0], 60) + rng.uniform(-3.0, 3.0, 60)
    trees = np.stack([reach * np.cos(around), radius + reach * np.sin(around)], axis=1)
    steering = np.arctan(2.83 / radius)
    encoder = speed * (1.0 - np.tan(steering) * 0.76 / 2.83)
    noise = 1.0 + 0.01 * rng.standard_normal(count + 1)
    time = 1000.0 * period * np.arange(count + 1)
    savemat(
        tmp_path / "aa3_dr.mat",
        {
            "time": time[:, None],
            "speed": (encoder * noise)[:, None],
            "steering": steering + 0.002 * rng.standard_normal((count + 1, 1)),
        },
    )
    scans = np.array([scan_of(trees, pose) for pose in scanner])
    intensity = rng.integers(0, 8, scans.shape)
    laser = (np.round(scans) + (intensity << 13)).astype(np.uint16)
    savemat(tmp_path / "aa3_lsr2.mat", {"TLsr": time[:, None], "LASER": laser})
    run = str(tmp_path / "run.circles")
    assert main(["import", str(tmp_path / "aa3_dr.mat"), "-o", run]) == 0
    recording = read_recording(run)
    assert len(recording) == count + 1
    assert 0.2 * len(recording) < len(recording.circles)
    found = str(tmp_path / "found.circles")
    local = ["--tilt-sigma-deg", "0", "--no-map-level"]
    assert main(["associate", run, "-o", found, *local]) == 0
    assert main(["map", found, "-o", str(tmp_path / "map")]) == 0
    # Both in the axes of the data set's robot at the first scan: X left, Y backward.
    path = read_path(tmp_path / "map" / "path.csv").poses[1:]
    true = np.stack([scanner[:, 1] - scanner[0, 1], scanner[0, 0] - scanner[:, 0]], axis=1)
    off = path[:, :2] - path[0, :2] - true
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.5


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"time": [0, 2, 1]}, "aa3_dr.mat: 1.000 follows 2.000: expected ascending times"),
        ({"TLsr": [1, 0]}, "aa3_lsr2.mat: 0.000 follows 1.000: expected ascending times"),
        ({"TLsr": [9, 9]}, "times 0.000 to 2.000, aa3_lsr2.mat: 9.000 to 9.000"),
        ({"speed": [np.nan, 1, 1]}, "aa3_dr.mat: speed: expected numbers within"),
        ({"steering": [0, 0, 1.4]}, "aa3_dr.mat: steering: expected angles within +-1.2 rad"),
        ({"time": [], "speed": [], "steering": []}, "times none, aa3_lsr2.mat: 0.000"),
    ],
)
def test_a_car_out_of_time_is_refused(
    changed: dict[str, list[float]],
    told: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    drive = {"time": [0, 1, 2], "speed": [1, 1, 1], "steering": [0, 0, 0], **changed}
    scans = {"TLsr": [0, 1], "LASER": np.full((2, 361), 10.0), **changed}
    savemat(tmp_path / "aa3_dr.mat", drive)
    savemat(tmp_path / "aa3_lsr2.mat", scans)
    target = str(tmp_path / "run.circles")
    assert main(["import", str(tmp_path / "aa3_dr.mat"), "-o", target]) == 1
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    ("compressed", "place", "junk"),
    [(False, 177, b"\xff"), (False, 136, None), (True, 150, b"\xff"), (True, 150, None)],
)
def test_a_damaged_file_of_the_car_is_refused(
    compressed: bool,
    place: int,
    junk: bytes | None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The first one ends SciPy's process."""
    file = tmp_path / "aa3_dr.mat"
    savemat(file, {"time": [0, 1], "speed": [1, 1], "steering": [0, 0]}, do_compression=compressed)
    whole = file.read_bytes()
    file.write_bytes(whole[:place] + (b"" if junk is None else junk + whole[place + 1 :]))
    assert main(["import", str(file), "-o", str(tmp_path / "run.circles")]) == 1
    assert "aa3_dr.mat: cannot be read" in capsys.readouterr().err


def test_trunks_are_found_where_nothing_hides_them() -> None:
    trees = np.array([[8.0, 3.0], [12.0, -2.0], [30.0, 0.5]])
    found = trees_of(scan_of(trees, np.zeros(3)) / 100.0)
    bearing = np.arctan2(trees[:, 1], trees[:, 0])
    order = np.argsort(bearing)
    assert found[:, 1] == pytest.approx(bearing[order], abs=np.radians(0.3))
    assert found[:, 0] == pytest.approx(np.hypot(*trees[order].T), abs=0.15)
    around = np.linspace(-1.0, 1.0, 15)
    for reach in (8.0, 20.0):
        ring = reach * np.stack([np.cos(around), np.sin(around)], axis=1)
        assert np.mean(trees_of(scan_of(ring, np.zeros(3)) / 100.0)[:, 0]) == pytest.approx(
            reach, abs=0.02
        )
    wall = np.full(361, 10.0)
    assert trees_of(wall).shape == (0, 2)


def test_covariances_of_range_and_bearing_are_right() -> None:
    rng = np.random.default_rng(3)
    count = 20_000
    reach, bearing = (
        4.0 + 0.05 * rng.standard_normal(count),
        0.6 + 0.01 * rng.standard_normal(count),
    )
    xy, _ = discs_of_ranges(reach, bearing, 0.05, 0.01)
    _, covariance = discs_of_ranges([4.0], [0.6], 0.05, 0.01)
    assert np.cov(xy.T) == pytest.approx(covariance[0], rel=0.05, abs=5e-5)
