"""Scans and scanners on disk: they come back as they were, and hostile files are refused."""

from __future__ import annotations

import gzip
import io
import json
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.scanners import (
    Robot,
    Scanner,
    Scans,
    find_scans,
    read_robot,
    read_scanners,
    read_scans,
    write_scanners,
)
from redetect.storage import OutputExistsError
from tools.simulator.laser.session_files import write_robot, write_scans


def sick(name: str = "fixed0", **changes: Any) -> Scanner:
    fields: dict[str, Any] = {
        "pose": np.array([1.0, -2.0, 0.5]),
        "covariance": np.diag([1e-4, 4e-4, 1e-6]),
        "first_angle_rad": -np.pi / 2,
        "angle_step_rad": np.pi / 180,
        "readings": 181,
        "max_range_m": 8.0,
        "sigma_m": 0.01,
    }
    return Scanner(name, **{**fields, **changes})


def scans(count: int = 3, readings: int = 5) -> Scans:
    times = 1235561680.25 + np.arange(count) / 75.0
    return Scans(times, np.arange(count * readings, dtype=np.uint16).reshape(count, readings))


# -- geometry -------------------------------------------------------------------------------


def test_beams_are_counted_counter_clockwise_from_the_first_angle() -> None:
    scanner = sick()
    ranges = np.zeros(181, dtype=np.uint16)
    ranges[[0, 90, 180, 45]] = 1000, 2000, 3000, 8000
    points = scanner.points(ranges)
    np.testing.assert_allclose(points[0], [0.0, -1.0], atol=1e-12)  # to the right
    np.testing.assert_allclose(points[90], [2.0, 0.0], atol=1e-12)  # ahead: the x axis
    np.testing.assert_allclose(points[180], [0.0, 3.0], atol=1e-12)
    assert np.isnan(points[45]).all()  # as long as the largest range: none
    assert np.isnan(points[1]).all()
    assert np.isfinite(scanner.metres(ranges)).sum() == 3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"readings": 0}, "readings is 0"),
        ({"readings": 10**9}, "readings"),
        ({"angle_step_rad": 0.0}, "angle_step_rad is 0"),
        ({"angle_step_rad": 0.05}, "one turn or less"),
        ({"angle_step_rad": float("nan")}, "angle_step_rad is nan"),
        ({"first_angle_rad": float("inf")}, "first_angle_rad"),
        ({"max_range_m": 0.0}, "max_range_m"),
        ({"sigma_m": -0.1}, "sigma_m"),
    ],
)
def test_scanners_that_cannot_be_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(GroundTruthError, match=message):
        sick(**changes)


@pytest.mark.parametrize("name", ["", "../up", "a/b", "a b", ".hidden", "x" * 65])
def test_names_that_are_no_file_names_are_refused(name: str) -> None:
    with pytest.raises(GroundTruthError, match="expected a name"):
        sick(name)


# -- scanners.json and robot.json -----------------------------------------------------------


def test_scanners_come_back(tmp_path: Path) -> None:
    path = tmp_path / "scanners.json"
    written = (sick("fixed0"), sick("fixed1", readings=361, angle_step_rad=np.pi / 360))
    write_scanners(path, written, {"note": "text"})
    read = read_scanners(path)
    assert [s.name for s in read] == ["fixed0", "fixed1"]
    for a, b in zip(written, read):
        for key in vars(a):
            np.testing.assert_array_equal(getattr(a, key), getattr(b, key))
    with pytest.raises(OutputExistsError):
        write_scanners(path, written)


def test_robot_comes_back(tmp_path: Path) -> None:
    outline = np.array([[0.4, 0.3], [-0.4, 0.3], [-0.4, -0.3], [0.4, -0.3]])
    write_robot(tmp_path / "robot.json", Robot(outline, 0.8, 1.2, (sick("front"),)))
    robot = read_robot(tmp_path / "robot.json")
    np.testing.assert_array_equal(robot.outline, outline)
    assert (robot.largest_speed_m_s, robot.largest_turn_rad_s) == (0.8, 1.2)
    assert [s.name for s in robot.scanners] == ["front"]


def entry(**changes: Any) -> dict[str, Any]:
    fields = {
        "name": "a", "pose": [0, 0, 0], "first_angle_rad": -1.5, "angle_step_rad": 0.0174533,
        "readings": 181, "max_range_m": 8.0, "sigma_m": 0.01,
    }  # fmt: skip
    return {**fields, **changes}


def test_poses_measured_by_hand_have_sigmas(tmp_path: Path) -> None:
    path = tmp_path / "scanners.json"
    content = {"version": 1, "scanners": [entry(pose_sigma=[0.1, 0.2, 0.05]), entry(name="b")]}
    path.write_text(json.dumps(content))
    first, second = read_scanners(path)
    np.testing.assert_allclose(first.covariance, np.diag([0.01, 0.04, 0.0025]))
    np.testing.assert_array_equal(second.covariance, 0.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "version is None"),
        ({"version": 2, "scanners": []}, "version is 2"),
        ({"version": 1}, "expected a list"),
        ({"version": 1, "scanners": [3]}, "expected a list of objects"),
        ({"version": 1, "scanners": [entry(), entry()]}, "more than once"),
        ({"version": 1, "scanners": [entry(name=3)]}, r"scanners\[0\]: name is 3"),
        ({"version": 1, "scanners": [entry(readings=1.5)]}, "readings is 1.5"),
        ({"version": 1, "scanners": [entry(readings=True)]}, "readings is True"),
        ({"version": 1, "scanners": [entry(pose=[0, 0])]}, "pose"),
        ({"version": 1, "scanners": [entry(pose=[0, 0, 10**400])]}, "pose"),
        ({"version": 1, "scanners": [entry(sigma_m="0.1")]}, "sigma_m"),
        ({"version": 1, "scanners": [entry(sigma_m=float("nan"))]}, "sigma_m"),
        ({"version": 1, "scanners": [entry(pose_sigma=[0, 0, -1])]}, "pose_sigma"),
        (
            {"version": 1, "scanners": [entry(covariance=[[1, 2, 0], [0, 1, 0], [0, 0, 1]])]},
            "symmetric",
        ),
        (
            {"version": 1, "scanners": [entry(covariance=[[1, 2, 0], [2, 1, 0], [0, 0, 1]])]},
            "negative eigenvalue",
        ),
        (
            {"version": 1, "scanners": [entry(pose_sigma=[1, 1, 1], covariance=[])]},
            "expected one of them",
        ),
    ],
)
def test_malformed_scanners_are_refused_by_place(
    tmp_path: Path, content: dict[str, Any], message: str
) -> None:
    path = tmp_path / "scanners.json"
    path.write_text(json.dumps(content))
    with pytest.raises(GroundTruthError, match=message) as error:
        read_scanners(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outline": [[0, 0], [1, 0]]}, "three or more corners"),
        ({"outline": [[0, 0], [1, 0], [1]]}, "outline"),
        ({"outline": None}, "outline"),
        ({"outline": [[0, 0], [1, 0], [0.5, 0], [0.5, 1]]}, r"robot.json: outline: folds back"),
        ({"largest_speed_m_s": 0}, "above 0"),
        ({"largest_turn_rad_s": None}, "largest_turn_rad_s"),
    ],
)
def test_malformed_robots_are_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = tmp_path / "robot.json"
    content = {
        "outline": [[0, 0], [1, 0], [1, 1]], "largest_speed_m_s": 1, "largest_turn_rad_s": 1
    }  # fmt: skip
    path.write_text(json.dumps({**content, **changes}))
    with pytest.raises(GroundTruthError, match=message):
        read_robot(path)


# -- scans ----------------------------------------------------------------------------------


@given(st.integers(1, 6), st.integers(1, 8), st.data())
def test_scans_come_back(count: int, readings: int, data: st.DataObject) -> None:
    times = np.sort(data.draw(arrays(np.float64, count, elements=st.floats(0, 2e9))))
    ranges = data.draw(arrays(np.uint16, (count, readings)))
    with tempfile.TemporaryDirectory() as folder:
        first, second = Path(folder) / "a.scans.npz", Path(folder) / "b.scans.npz"
        write_scans(first, Scans(times, ranges))
        write_scans(second, Scans(times.copy(), ranges.copy()))
        assert first.read_bytes() == second.read_bytes()
        read = read_scans(first, readings)
        np.testing.assert_array_equal(read.times_s, times)
        np.testing.assert_array_equal(read.ranges_mm, ranges)
        with pytest.raises(OutputExistsError):
            write_scans(first, read)
        with pytest.raises(GroundTruthError, match=f"expected {readings + 1}"):
            read_scans(first, readings + 1)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("numbered", [False, True])
def test_rows_in_metres_are_read(tmp_path: Path, packed: bool, numbered: bool) -> None:
    rows = ["# t, readings", "5.25,1.0004,0.0,81.83", "", "5.5,2.5,3.25,65.535"]
    if numbered:
        rows = [f"{i},{row}" if row[:1].isdigit() else row for i, row in enumerate(rows)]
    else:
        rows.insert(0, "t,r0,r1,r2")
    data = ("\n".join(rows) + "\n").encode()
    path = tmp_path / f"a.scans.csv{'.gz' if packed else ''}"
    path.write_bytes(gzip.compress(data) if packed else data)
    read = read_scans(path, 3 if numbered else None)
    np.testing.assert_array_equal(read.times_s, [5.25, 5.5])
    # 81.83 m is more than 65.535 m: none.
    np.testing.assert_array_equal(read.ranges_mm, [[1000, 0, 0], [2500, 3250, 65535]])


def test_numbers_that_are_none_are_said_to_be_finite(tmp_path: Path) -> None:
    """Readings may be larger than other numbers, as of beams without a return."""
    (tmp_path / "a.scans.csv").write_text("1.0,3e38,1.0\n2.0,nan,1.0\n")
    with pytest.raises(GroundTruthError, match=r"'nan': expected a finite number$"):
        read_scans(tmp_path / "a.scans.csv")


def test_infinite_readings_are_no_returns_but_infinite_times_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.scans.csv"
    path.write_text("5.0,1,inf,2\n")
    np.testing.assert_array_equal(read_scans(path, 3).ranges_mm, [[1000, 0, 2000]])
    path.write_text("inf,1,2,3\n")
    with pytest.raises(GroundTruthError, match="'inf': expected a finite number"):
        read_scans(path, 3)


def test_a_scanner_mounted_upside_down_turns_the_other_way() -> None:
    down = sick(first_angle_rad=np.pi / 2, angle_step_rad=-np.pi / 180)
    np.testing.assert_allclose(down.angles_rad, -sick().angles_rad)


def test_the_real_log_is_read(shared_data: Path) -> None:
    log = shared_data / "rawseeds" / "laser" / "intel-lab.scans.csv.gz"
    with pytest.raises(GroundTruthError, match=r"scan 20 of 2672 .* in order"):
        read_scans(log, 180)
    read = read_scans(log, 180, ordered=False)
    poses = (log.parent / "intel-lab.poses.csv").read_text().splitlines()
    assert len(read) == len(poses)
    assert read.times_s[0] == 976053557.767368
    assert read.ranges_mm[0, :4].tolist() == [0, 3360, 3340, 0]
    assert read.ranges_mm[0, 6] == 7700


def test_the_file_of_a_scanner_is_found(tmp_path: Path) -> None:
    with pytest.raises(GroundTruthError, match=r"no scans of scanner 'a'"):
        find_scans(tmp_path, "a")
    write_scans(tmp_path / "a.scans.npz", scans())
    assert find_scans(tmp_path, "a") == tmp_path / "a.scans.npz"
    (tmp_path / "a.scans.csv").write_text("0,1\n")
    with pytest.raises(GroundTruthError, match="in 2 files"):
        find_scans(tmp_path, "a")


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("", None, "no scans"),
        ("1,2,3\n1,2\n", 2, "2 numbers: expected 3"),
        ("1\n", 1, "expected a time and readings"),
        ("1,2,nan\n", 1, "finite"),
        ("1,2,1e999\n", 1, "finite"),
        ("1,2,1_0\n", 1, "finite"),
        ("1,2,\n", 1, "finite"),
        ("1,2,3\nt,4,5\n", 2, "finite"),
        ("1,2,-0.5\n", 1, "below 0"),
        ("2,2,3\n1,2,3\n", None, "scan 2 of 2 .* in order"),
        ("\u20ac" * 5, 1, "finite"),
        ("1" + ",2" * 5000, None, "1 to 4096"),
    ],
)
def test_malformed_rows_are_refused_by_line(
    tmp_path: Path, text: str, line: int | None, message: str
) -> None:
    path = tmp_path / "a.scans.csv"
    path.write_text(text)
    with pytest.raises(GroundTruthError, match=message) as error:
        read_scans(path)
    assert str(error.value).startswith(f"{path}: " if line is None else f"{path}:{line}: ")


def test_files_that_are_no_text_or_cut_off_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.scans.csv.gz"
    path.write_bytes(gzip.compress(b"1,2,3\n" * 9)[:-9])
    with pytest.raises(GroundTruthError, match="gzip"):
        read_scans(path)
    path.write_bytes(b"1,2,3\n")
    with pytest.raises(GroundTruthError, match="gzip"):
        read_scans(path)
    plain = tmp_path / "b.scans.csv"
    plain.write_bytes(b"\xff\xfe\x00\n")
    with pytest.raises(GroundTruthError, match="not text"):
        read_scans(plain)
    with pytest.raises(GroundTruthError, match="no such file"):
        read_scans(tmp_path / "c.scans.csv")


def npy(array: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def archive(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)
    return path


class Explosive:
    """What unpickling would set off."""

    def __reduce__(self) -> Any:
        return (pytest.fail, ("a pickle was opened",))


def header(shape: str, descr: str = "'<u2'", fortran: str = "False") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


TIMES = npy(np.arange(3.0))
RANGES = npy(np.zeros((3, 5), np.uint16))


@pytest.mark.parametrize(
    ("times", "ranges", "message"),
    [
        (npy(np.array([Explosive()] * 3)), RANGES, "times_s.*object"),
        (TIMES, npy(np.array([[Explosive()]])), "ranges_mm.*object"),
        (npy(np.arange(3, dtype=np.float32)), RANGES, "float32"),
        (TIMES, npy(np.zeros((3, 5), np.int64)), "int64"),
        (TIMES, npy(np.zeros((3, 5, 2), np.uint16)), "2-dimensional"),
        (TIMES, npy(np.zeros((4, 5), np.uint16)), "expected 3 scans"),
        (npy(np.zeros(0)), npy(np.zeros((0, 5), np.uint16)), "no scans in it"),
        (TIMES, npy(np.zeros((3, 0), np.uint16)), "readings"),
        (TIMES, npy(np.zeros((3, 4097), np.uint16)), "readings"),
        (npy(np.array([0.0, 2.0, 1.0])), RANGES, "in order"),
        (npy(np.array([0.0, np.nan, 1.0])), RANGES, "not finite"),
        (TIMES, header("(3, 1000000000000)"), "does not fit"),
        (TIMES, header("(10**30, 5)"), "ranges_mm"),
        (TIMES, header("(-3, -5)") + bytes(30), "does not fit"),
        (TIMES, header("(3, 5)", fortran="True") + bytes(30), "row by row"),
        (TIMES, header("(3, 5)") + bytes(29), "ranges_mm"),
        (TIMES, header("(3, 5)", "'|O'") + bytes(30), "object"),
        (TIMES, header("__import__('os')"), "ranges_mm"),
        (TIMES, b"\x93NUMPY\x09\x00" + bytes(50), "version"),
        (TIMES, b"not an array", "ranges_mm"),
        (TIMES, b"", "ranges_mm"),
    ],
)
def test_hostile_arrays_are_refused(
    tmp_path: Path, times: bytes, ranges: bytes, message: str
) -> None:
    path = archive(tmp_path / "a.scans.npz", times_s=times, ranges_mm=ranges)
    with pytest.raises(GroundTruthError, match=message) as error:
        read_scans(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_archives_that_lie_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.scans.npz"
    for data in (b"", b"PK\x03\x04 no archive", bytes(1000), TIMES):
        path.write_bytes(data)
        with pytest.raises(GroundTruthError, match="npz"):
            read_scans(path)
    with pytest.raises(GroundTruthError, match="no such file"):
        read_scans(tmp_path / "b.scans.npz")
    with pytest.raises(GroundTruthError, match="ranges_mm: no such array"):
        read_scans(archive(path, times_s=TIMES))


def test_a_packed_giant_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("redetect.groundtruth.lasers.scanners._LARGEST_FILE_BYTES", 1 << 16)
    giant = npy(np.zeros((1 << 10, 100), np.uint16))
    path = archive(tmp_path / "a.scans.npz", times_s=npy(np.zeros(1 << 10)), ranges_mm=giant)
    assert path.stat().st_size < 1 << 12
    with pytest.raises(GroundTruthError, match="larger than 65536 bytes"):
        read_scans(path)
    rows = tmp_path / "a.scans.csv.gz"
    rows.write_bytes(gzip.compress(b"1,2,3\n" * (1 << 14)))
    with pytest.raises(GroundTruthError, match="more than 65536"):
        read_scans(rows)


@given(st.binary(max_size=200), st.integers(0, 600))
def test_damaged_archives_never_do_more_than_be_refused(noise: bytes, at: int) -> None:
    stream = io.BytesIO()
    np.savez_compressed(stream, times_s=np.arange(3.0), ranges_mm=np.ones((3, 5), np.uint16))
    whole = stream.getvalue()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.scans.npz"
        path.write_bytes(whole[:at] + noise + whole[at + len(noise) :])
        try:
            read = read_scans(path)
        except GroundTruthError:
            return
        assert read.ranges_mm.shape[0] == len(read)
