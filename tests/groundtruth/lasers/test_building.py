"""Building maps: what was drawn comes back, and files that are none are refused."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ezdxf.filemanagement import new
from hypothesis import given
from hypothesis import strategies as st

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.building import (
    CURVE_TOLERANCE_M,
    find_building,
    read_building,
)
from redetect.storage import OutputExistsError
from tools.simulator.laser.session_files import write_building, write_drawing

SQUARE = [(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)]

micro = st.integers(-50_000_000, 50_000_000).map(lambda n: n / 1e6)
# A drawing need not keep a wall without length.
wall = st.tuples(micro, micro, micro, micro).filter(lambda w: abs(w[0] - w[2]) > 1e-5)


@given(st.lists(wall, min_size=1, max_size=6))
def test_walls_come_back_from_rows_and_from_a_drawing(walls: list[tuple[float, ...]]) -> None:
    building = np.array(walls)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_building(folder / "building.csv", building)
        write_drawing(folder / "building.dxf", building)
        for file in ("building.csv", "building.dxf"):
            np.testing.assert_allclose(read_building(folder / file), building, rtol=0, atol=1e-9)
        with pytest.raises(OutputExistsError):
            write_building(folder / "building.csv", building)


def test_rows_may_have_comments_and_no_head(tmp_path: Path) -> None:
    path = tmp_path / "building.csv"
    path.write_text("# walls\n\n0,0, 4,0\n4,0,4,3 # the eastern one\n")
    np.testing.assert_array_equal(read_building(path), [[0, 0, 4, 0], [4, 0, 4, 3]])


def drawing(**header: int) -> Any:
    document = new("R2010", setup=True)
    for key, value in header.items():
        document.header[f"${key}"] = value
    return document


@pytest.mark.lowest
def test_lines_polylines_and_blocks_are_walls_and_texts_are_not(tmp_path: Path) -> None:
    document = drawing(INSUNITS=6)
    space = document.modelspace()
    space.add_line((0, 0, 0), (4, 0, 2.5))  # height is left out
    space.add_line((1, 1, 0), (1, 1, 3))  # upright: a point
    space.add_lwpolyline(SQUARE, close=True)
    space.add_polyline2d([(5, 0), (6, 0), (6, 1)])
    space.add_text("hall")
    space.add_linear_dim(base=(0, -1), p1=(0, 0), p2=(4, 0)).render()
    block = document.blocks.new("door")
    block.add_line((0, 0), (1, 0))
    space.add_blockref("door", (10, 0), dxfattribs={"rotation": 90, "xscale": 2, "yscale": 2})
    document.saveas(tmp_path / "b.dxf")
    expected = [[0, 0, 4, 0], [0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0],
                [5, 0, 6, 0], [6, 0, 6, 1], [10, 0, 10, 2]]  # fmt: skip
    found = read_building(tmp_path / "b.dxf")
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_curved_walls_are_cut_finely(tmp_path: Path) -> None:
    document = drawing(INSUNITS=6)
    document.modelspace().add_circle((1, 2), 3.0)
    # A bulge of 1 is half a circle to the right of the line between its ends.
    document.modelspace().add_lwpolyline([(10, 0, 1.0), (14, 0, 0.0)], format="xyb")
    document.saveas(tmp_path / "b.dxf")
    segments = read_building(tmp_path / "b.dxf")
    middles = 0.5 * (segments[:, :2] + segments[:, 2:])
    circle = segments[:, 0] < 5.0
    assert circle.sum() > 20
    assert (~circle).sum() > 10
    for which, centre, radius in ((circle, (1, 2), 3.0), (~circle, (12, 0), 2.0)):
        ends = np.hypot(*(segments[which, :2] - centre).T)
        np.testing.assert_allclose(ends, radius, atol=1e-9)
        inside = radius - np.hypot(*(middles[which] - centre).T)
        assert inside.max() < CURVE_TOLERANCE_M
    assert middles[~circle, 1].max() < 0.0


@pytest.mark.lowest
@pytest.mark.parametrize(("unit", "metres"), [(4, 1e-3), (0, 1.0), (1, 0.0254)])
def test_units_of_the_drawing(tmp_path: Path, unit: int, metres: float) -> None:
    document = drawing(INSUNITS=unit)
    document.modelspace().add_line((1000, 0), (1000, 500))
    document.saveas(tmp_path / "b.dxf")
    found = read_building(tmp_path / "b.dxf")
    np.testing.assert_allclose(found, metres * np.array([[1000, 0, 1000, 500]]))


def test_a_block_within_itself_is_refused(tmp_path: Path) -> None:
    document = drawing()
    for name, other in (("a", "b"), ("b", "a")):
        block = document.blocks.new(name)
        block.add_line((0, 0), (1, 0))
        block.add_blockref(other, (1, 0))
    document.modelspace().add_blockref("a", (0, 0))
    document.saveas(tmp_path / "b.dxf")
    with pytest.raises(GroundTruthError, match=r"b\.dxf: blocks nested"):
        read_building(tmp_path / "b.dxf")


def test_blocks_that_multiply_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("redetect.groundtruth.lasers.building.MOST_SEGMENTS", 500)
    document = drawing()
    for level in range(6):
        block = document.blocks.new(f"l{level}")
        for x in range(10):
            if level == 0:
                block.add_line((x, 0), (x, 1))
            else:
                block.add_blockref(f"l{level - 1}", (x, 0))
    document.modelspace().add_blockref("l5", (0, 0))
    document.saveas(tmp_path / "b.dxf")
    with pytest.raises(GroundTruthError, match="more than 500"):
        read_building(tmp_path / "b.dxf")


def test_a_circle_as_large_as_the_world_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("redetect.groundtruth.lasers.building.MOST_SEGMENTS", 500)
    document = drawing(INSUNITS=6)
    document.modelspace().add_circle((0, 0), 1e5)
    document.saveas(tmp_path / "b.dxf")
    with pytest.raises(GroundTruthError, match="more than 500 walls"):
        read_building(tmp_path / "b.dxf")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"no drawing",
        b"0\nSECTION\n",
        b"\x00\xff" * 50,
        b"0\nSECTION\n2\nENTITIES\n0\nLINE\n10\nx\n",
    ],
)
def test_files_that_are_no_drawing_are_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "b.dxf"
    path.write_bytes(data)
    with pytest.raises(GroundTruthError) as error:
        read_building(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected walls"),
        ("x1_m,y1_m,x2_m,y2_m\n", "expected walls"),
        ("1,2,3\n", ":1: 3 words"),
        ("1,2,3,4\n1,2,3,nan\n", ":2: "),
        ("1,2,3,4\nx1_m,y1_m,x2_m,y2_m\n", ":2: "),
        ("1,2,3,1e7\n", "farther away"),
        ("1,2,1,2\n", "expected walls"),
    ],
)
def test_malformed_rows_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "building.csv"
    path.write_text(text)
    with pytest.raises(GroundTruthError, match=message) as error:
        read_building(path)
    assert str(path) in str(error.value)


def test_walls_without_length_are_dropped(tmp_path: Path) -> None:
    (tmp_path / "building.csv").write_text("0,0,4,0\n4,0,4,0\n")
    assert read_building(tmp_path / "building.csv").tolist() == [[0.0, 0.0, 4.0, 0.0]]


def test_the_map_of_a_session_is_found(tmp_path: Path) -> None:
    with pytest.raises(GroundTruthError, match="neither"):
        find_building(tmp_path)
    building = np.array([[0.0, 0.0, 1.0, 1.0]])
    write_drawing(tmp_path / "building.dxf", building)
    assert find_building(tmp_path).name == "building.dxf"
    write_building(tmp_path / "building.csv", building)
    assert find_building(tmp_path).name == "building.csv"
    with pytest.raises(GroundTruthError, match="no such file"):
        read_building(tmp_path / "other.csv")


def test_without_ezdxf_it_is_said_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_drawing(tmp_path / "building.dxf", np.array([[0.0, 0.0, 4.0, 0.0]]))
    for name in ("ezdxf", "ezdxf.enums", "ezdxf.filemanagement"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(GroundTruthError, match=r"pip install 'redetect\[dxf\]'"):
        read_building(tmp_path / "building.dxf")
