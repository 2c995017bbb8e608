"""Files of poses and times: the real ones come back, malformed ones are refused by line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.trajectories import se3
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    format_tum,
    read_planar_poses,
    write_planar_poses,
)
from redetect.storage import OutputExistsError

SESSIONS = ("Bicocca_2009-02-25a", "Bicocca_2009-02-26a")

micro = st.integers(-20_000_000, 20_000_000).map(lambda n: n / 1e6)
tiny = st.integers(-(10**9), 10**9).map(lambda n: n / 1e12)
#: Which of six numbers are where in a symmetric matrix.
MATRIX = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@pytest.mark.parametrize("session", SESSIONS)
def test_real_ground_truth_comes_back_byte_by_byte(
    shared_data: Path, tmp_path: Path, session: str
) -> None:
    path = shared_data / "rawseeds" / "gt" / session / f"{session}-GROUNDTRUTH.csv"
    poses = read_planar_poses(path)
    write_planar_poses(tmp_path / "again.csv", poses)
    # Its covariances have six decimals, ours twelve.
    written = (tmp_path / "again.csv").read_text()
    assert re.sub(r"(\.\d{6})0{6}\b", r"\1", written) == path.read_text()
    assert np.diff(poses.times_s).max() > 60.0  # segments, minutes apart
    assert np.isfinite(poses.poses).all()
    if session.endswith("25a"):
        assert poses.poses[:, 2].min() < -np.pi  # past the cut, and kept so


@pytest.mark.parametrize("session", SESSIONS)
def test_real_solutions_without_covariances_are_read(shared_data: Path, session: str) -> None:
    folder = shared_data / "rawseeds" / "gt" / session
    for name in ("ndt_mcl_0.5.csv", f"{session}-GT-extended.csv"):
        poses = read_planar_poses(folder / name)
        assert poses.covariances is None
        assert len(poses) > 1000


@given(
    st.lists(st.tuples(micro, micro, micro, st.lists(tiny, min_size=6, max_size=6)), max_size=5),
    st.booleans(),
)
def test_what_is_written_is_read_back(
    rows: list[tuple[float, float, float, list[float]]], with_covariance: bool
) -> None:
    import tempfile

    poses = PlanarPoses(
        np.array([1235561680.680798 + 0.5 * i for i in range(len(rows))]),
        np.array([row[:3] for row in rows]).reshape(-1, 3),
        np.array([row[3] for row in rows]).reshape(-1, 6)[:, MATRIX] if with_covariance else None,
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "poses.csv"
        write_planar_poses(path, poses)
        if not rows:
            with pytest.raises(GroundTruthError, match="no poses"):
                read_planar_poses(path)
            return
        read = read_planar_poses(path)
    np.testing.assert_array_equal(read.times_s, poses.times_s)
    np.testing.assert_array_equal(read.poses, poses.poses)
    if poses.covariances is None:
        assert read.covariances is None
    else:
        np.testing.assert_array_equal(read.covariances, poses.covariances)


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("1,2,3,4\n1,2,3\n", 2, "3 numbers: expected 4: t, x, y, theta$"),
        ("1,2,3\n", 1, "expected 4 or 13"),
        ("1,2,3,4\n\n0.5,2,3,4\n", 3, "before the row above"),
        ("1,2,nan,4\n", 1, "'nan': expected a finite number"),
        ("1,2,1e999,4\n", 1, "expected a finite number"),
        ("1,-1e300,3,4\n", 1, "'-1e300': expected a finite number, within"),
        ("1,2,1_0,4\n", 1, "expected a finite number"),
        ("1,2,,4\n", 1, "'': expected a finite number"),
        ("1 2 3 4\n1,2,3,4" + ",0" * 9, 2, "13 numbers: expected 4"),
        ("1 2 3 4  4 0 1  0 4 0  1 0 4\n2 2 3 4  4 0 1  0 4 0  0 0 4\n", 2, "not symmetric"),
    ],
)
def test_malformed_streams_are_refused_by_line(
    tmp_path: Path, text: str, line: int, problem: str
) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(GroundTruthError, match=problem) as caught:
        read_planar_poses(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")


@given(st.binary(max_size=200))
def test_any_bytes_are_poses_or_a_typed_error(content: bytes) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "poses.csv"
        path.write_bytes(content)
        message = str(path)
        try:
            read_planar_poses(path)
        except GroundTruthError as error:
            message = str(error)
        assert message.startswith(str(path))


def test_files_are_not_overwritten_unasked(tmp_path: Path) -> None:
    poses = PlanarPoses(np.zeros(1), np.zeros((1, 3)))
    path = tmp_path / "poses.csv"
    write_planar_poses(path, poses)
    with pytest.raises(OutputExistsError):
        write_planar_poses(path, poses)
    write_planar_poses(path, poses, overwrite=True)
    with pytest.raises(GroundTruthError, match="no such file"):
        read_planar_poses(tmp_path / "absent.csv")


def test_poses_that_cannot_be_are_refused() -> None:
    with pytest.raises(GroundTruthError, match="expected times in order"):
        PlanarPoses(np.array([2.0, 1.0]), np.zeros((2, 3)))
    with pytest.raises(GroundTruthError, match="not finite"):
        PlanarPoses(np.zeros(1), np.full((1, 3), np.nan))


def test_tum_rows_are_the_pose(tmp_path: Path) -> None:
    poses = se3.exp(np.random.default_rng(1).normal(size=(3, 6)))
    rows = [
        [float(word) for word in line.split()]
        for line in format_tum(np.array([1.5, 2.0, 2.5]), poses).splitlines()
    ]
    for row, time, pose in zip(rows, (1.5, 2.0, 2.5), poses):
        assert row[0] == time
        turn = Rotation.from_quat(row[4:]).as_matrix()
        np.testing.assert_allclose(se3.transform(turn, row[1:4]), pose, atol=1e-6)
    assert format_tum(np.zeros(0), np.zeros((0, 4, 4))) == ""
