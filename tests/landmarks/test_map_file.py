"""Maps and paths come back from the disk as they were, and malformed ones are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from redetect.landmarks import LandmarkFileError
from redetect.landmarks.map_file import (
    LandmarkMap,
    MapLandmarks,
    Path2D,
    no_landmarks,
    read_map,
    read_path,
    write_map,
    write_path,
)
from redetect.storage import OutputExistsError

HEAD = "kind,id,x_m,y_m,cxx_m2,cxy_m2,cyy_m2,rows\n"


def test_a_map_comes_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(0, 0.1, (5, 2, 2))
    discs = MapLandmarks(
        ids=np.array([5, 1, 9, 2, 2**62]),
        xy=rng.normal(0, 9, (5, 2)),
        covariance=root @ np.swapaxes(root, 1, 2),
        rows=np.arange(5),
    )
    write_map(tmp_path / "m.csv", LandmarkMap(discs, no_landmarks()), ["made by a test"])
    again = read_map(tmp_path / "m.csv")
    np.testing.assert_array_equal(again.discs.ids, discs.ids)
    np.testing.assert_array_equal(again.discs.xy, discs.xy)
    np.testing.assert_array_equal(again.discs.rows, discs.rows)
    np.testing.assert_allclose(again.discs.covariance, discs.covariance, rtol=1e-12)
    assert len(again.lines) == 0
    with pytest.raises(OutputExistsError):
        write_map(tmp_path / "m.csv", again)
    # As spreadsheets save it, with a byte order mark.
    (tmp_path / "marked.csv").write_bytes(b"\xef\xbb\xbf" + (tmp_path / "m.csv").read_bytes())
    np.testing.assert_array_equal(read_map(tmp_path / "marked.csv").discs.ids, discs.ids)


@pytest.mark.parametrize("with_covariance", [True, False])
def test_a_path_comes_back(tmp_path: Path, with_covariance: bool) -> None:
    rng = np.random.default_rng(4)
    path = Path2D(
        ("start", "a,b", 'c"d'),
        rng.normal(size=(3, 3)),
        rng.normal(size=(3, 3, 3)) if with_covariance else None,
    )
    write_path(tmp_path / "p.csv", path)
    again = read_path(tmp_path / "p.csv")
    assert again.prefixes == path.prefixes
    np.testing.assert_array_equal(again.poses, path.poses)
    if path.covariance is None:
        assert again.covariance is None
    else:
        np.testing.assert_array_equal(again.covariance, path.covariance)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no rows"),
        (HEAD, "no rows"),
        ("a,b\n1,2\n", ":1: expected the columns kind,id"),
        (HEAD + "tree,1,0,0,1,0,1,3\n", ":2: kind is 'tree'"),
        (HEAD + "disc,1.5,0,0,1,0,1,3\n", ":2: id is '1.5'"),
        (HEAD + "disc,1,nan,0,1,0,1,3\n", ":2: x_m is 'nan'"),
        (HEAD + "disc,1,0,0,1,2,1,3\n", "covariance is negative"),
        (HEAD + "disc,1,0,0,1,0,1,3\n\ndisc,1,0,0,1,0,1,3\n", ":4: disc 1 is already in the map"),
        (HEAD + "disc,1,0,0,1,0,1\n", ":2: 7 values: expected 8"),
        (HEAD + "disc,1,0,1e300,1,0,1,3\n", ":2: y_m is '1e300': expected .* within"),
        (HEAD + "x" * 200_000, ":2: field larger than field limit"),
    ],
)
def test_a_malformed_map_names_the_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(LandmarkFileError, match=message):
        read_map(tmp_path / "m.csv")


@pytest.mark.parametrize("mark", ["\u2028", "\x85", "\x0b", "\x1c"])
def test_prefixes_of_a_path_may_have_any_other_mark(tmp_path: Path, mark: str) -> None:
    path = Path2D((f"a{mark}b",), np.zeros((2, 3)))
    write_path(tmp_path / "p.csv", path)
    assert read_path(tmp_path / "p.csv").prefixes == path.prefixes
