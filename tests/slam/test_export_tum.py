"""TUM trajectories: written as the format demands, read back, and refused line by line."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from redetect.landmarks import wrap_angle
from redetect.landmarks.map_file import Path2D
from redetect.slam.errors import SlamError
from redetect.slam.formats.tum import read_tum, write_tum
from redetect.storage import OutputExistsError

numbers = st.floats(-1e6, 1e6)
angles = st.floats(-20.0, 20.0)


@given(st.lists(st.tuples(numbers, numbers, angles), min_size=1, max_size=8))
def test_a_path_comes_back(
    tmp_path_factory: pytest.TempPathFactory,
    poses: list[tuple[float, float, float]],
) -> None:
    file = tmp_path_factory.mktemp("tum") / "p.tum"
    path = Path2D(tuple(f"p{k}" for k in range(len(poses))), np.array(poses))
    write_tum(file, path)
    again = read_tum(file)
    np.testing.assert_array_equal(again.poses[:, :2], path.poses[:, :2])
    turn = wrap_angle(again.poses[:, 2] - path.poses[:, 2])
    np.testing.assert_allclose(turn, 0.0, atol=1e-14)
    assert np.all(np.abs(again.poses[:, 2]) <= np.pi)
    assert again.prefixes[0] == "start"
    assert again.prefixes[1:] == tuple(map(str, range(1, len(poses))))


def test_a_robot_that_turned_left_ahead_of_the_start(tmp_path: Path) -> None:
    """2 m forward (-Y in the data set's axes), then a quarter turn to the left."""
    path = Path2D(("start", "a"), np.array([[0.0, 0.0, 0.0], [0.0, -2.0, np.pi / 2]]))
    write_tum(tmp_path / "p.tum", path)
    rows = [row for row in (tmp_path / "p.tum").read_text().splitlines() if row[0] != "#"]
    assert rows[0].split() == ["0", "0.0", "0.0", "0", "0", "0", "0.0", "1.0"]
    np.testing.assert_allclose(
        [float(word) for word in rows[1].split()],
        [1.0, 2.0, 0.0, 0.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)],
        atol=1e-15,
    )
    with pytest.raises(OutputExistsError):
        write_tum(tmp_path / "p.tum", path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no poses"),
        ("# only a comment\n", "no poses"),
        ("0 1 2 0 0 0 0\n", ":1: .*expected 8 numbers: t x y z"),
        ("0 1 2 0 0 0 0 1\n\n1 nan 2 0 0 0 0 1\n", ":3: .*expected 8 numbers"),
        ("0 1,0 2 0 0 0 0 1\n", ":1: .*expected 8 numbers"),
        ("0 1 1e999 0 0 0 0 1\n", ":1: .*expected 8 numbers"),
        ("1 1 2 0 0 0 0 1\n1 1 2 0 0 0 0 1\n", ":2: t is 1.0: expected more"),
        ("0 1 2 0 0 0 0 0.9\n", ":1: qx qy qz qw are no unit quaternion"),
        ("0 1 2 0.5 0 0 0 1\n", ":1: expected a pose on the floor"),
        ("0 1 2 0 0.6 0 0 0.8\n", ":1: expected a pose on the floor"),
    ],
)
def test_what_is_no_path_on_the_floor_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "p.tum").write_text(text)
    with pytest.raises(SlamError, match=message):
        read_tum(tmp_path / "p.tum")


@settings(max_examples=100)
@given(st.binary(max_size=40), st.integers(0, 80), st.integers(0, 20))
def test_damaged_files_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, junk: bytes, place: int, length: int
) -> None:
    whole = b"# a comment\n0 1.5 2 0 0 0 0 1\n1 1 2.5 0 0 0 0.6 0.8\n"
    file = tmp_path_factory.mktemp("tum") / "a.tum"
    file.write_bytes(whole[:place] + junk + whole[place + length :])
    with contextlib.suppress(SlamError):
        assert np.isfinite(read_tum(file).poses).all()


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(SlamError, match="no such TUM trajectory"):
        read_tum(tmp_path / "p.tum")
