"""Readers of landmarks and of results made from them: rows, tilts, maps, graphs, paths."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from redetect.landmarks import LandmarkError, frames_of_rows, parse_rows, read_rows
from redetect.landmarks.files import format_record
from redetect.landmarks.frame_files import read_tilts, read_times
from redetect.landmarks.map_file import covariance_file, read_map, read_path, with_joint_covariance
from redetect.slam.errors import SlamError
from redetect.slam.formats.g2o import read_g2o
from redetect.slam.formats.tum import read_tum
from tools.fuzz.reader import NUMBERS, Reader


def _landmarks(path: Path) -> object:
    """Frames of a file; rows and records that were accepted can be written again unchanged."""
    rows = list(read_rows(path))
    assert b"".join(row.source or b"" for row in rows) == path.read_bytes(), "round trip"
    frames = list(frames_of_rows(rows))
    # Only a file's first row may begin with a byte order mark, which is not part of it.
    again = "#\n" + "".join(f"{format_record(r.record)}\n" for r in rows if r.record is not None)
    encoded = again.encode("utf-8", "surrogateescape")
    once = [row.record for row in parse_rows(io.BytesIO(encoded)) if row.record is not None]
    twice = "#\n" + "".join(f"{format_record(record)}\n" for record in once)
    assert len(once) == sum(row.record is not None for row in rows), "records lost in writing"
    assert twice == again, "written records change when they are read"
    return frames


def _npy(array: object) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.asarray(array))
    return stream.getvalue()


def _joint(path: Path) -> object:
    map_file = path.parent / "map.csv"
    assert covariance_file(map_file).name == path.name
    return with_joint_covariance(read_map(map_file), map_file)


_STEP = b"STEP e.0000  0.00088 -0.15647  0.01153 1e-5 0 1e-5 0 0 1e-4\n"
_CIRCLE = b"LANDMARK_C 0.31 -2.5 0.81 0.0016 1e-5 0.0021 17\n"
_LINE = b"LANDMARK_L 0.1 -0.2 0.1 0.3 0.02 0.001 0 0.002 -1\n"
_MARKER = b"LANDMARK_M rawseeds 3 0.99" + b" 10 20 0.1 0 0.1" * 4 + b"\n"
_SETTINGS = b"CIRCLEMARKDETECTOR e.cam nohalf 0.1 0.6\n"
_IDENTITY_4 = "1 0 0 1 0 1"
_G2O = f"""# a comment
VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 0.5 0 0.1
VERTEX_XY 12 1 1
EDGE_SE2 0 1 0.5 0 0.1 {_IDENTITY_4}
EDGE_SE2_XY 1 12 0.5 1 4 0 4
FIX 0
""".encode()
_MAP_HEAD = "kind,id,x_m,y_m,cxx_m2,cxy_m2,cyy_m2,rows\n"
_MAP = _MAP_HEAD + "disc,3,1.0,2.0,0.01,0.0,0.01,5\nline,-1,1.5,2.0,0.01,0.001,0.01,2\n"
_PATH = "# by hand\nprefix,x_m,y_m,theta_rad\nstart,0,0,0\ne.0001,0.1,-0.2,3\n"
_MAP_OF_ONE = (_MAP_HEAD + "disc,3,1.0,2.0,0.01,0.0,0.01,5\n").encode()

_RECORDS = (
    _SETTINGS + _STEP + _CIRCLE + _LINE + _MARKER,
    _STEP + b"# c \\\n" + _CIRCLE[:20] + b"\\\n" + _CIRCLE[20:].replace(b"\n", b"\r\n"),
    b"\xef\xbb\xbf" + _STEP,
)
_RECORD_WORDS = (
    b"STEP", b"LANDMARK", b"LANDMARK_C", b"LANDMARK_L", b"LANDMARK_M", b"XDETECTOR", b"\\\n",
    b"\r\n", *NUMBERS,
)  # fmt: skip
_G2O_WORDS = (
    b"VERTEX_SE2 ", b"VERTEX_XY ", b"EDGE_SE2 ", b"EDGE_SE2_XY ", b"FIX ", *NUMBERS,
)  # fmt: skip
_LANDMARK, _SLAM = (LandmarkError,), (SlamError,)

LANDMARK_READERS: tuple[Reader, ...] = (
    Reader("landmarks", "e.circles", _landmarks, _LANDMARK, _RECORDS, _RECORD_WORDS),
    Reader("tilts", "e.tilt", read_tilts, _LANDMARK,
           (b"# x\nTILT e.0000 0.01 -0.02 1e-6 0 1e-6 9\nNOTILT e.0001 2\n",),
           (b"TILT", b"NOTILT", *NUMBERS)),
    Reader("times", "e.times", read_times, _LANDMARK, (b"e.0000 0.1\ne.0001 0.2\n",), NUMBERS),
    Reader("map", "map.csv", read_map, _LANDMARK, (_MAP.encode(),),
           (b"disc,", b"line,", b'"', *NUMBERS)),
    Reader("path", "path.csv", read_path, _LANDMARK, (_PATH.encode(),),
           (b"start,", b'"', *NUMBERS)),
    Reader("map covariance", covariance_file(Path("map.csv")).name, _joint, _LANDMARK,
           (_npy(0.01 * np.eye(2)),), (b"NUMPY", b"'descr': '|O'", b"(2, 2)"),
           {"map.csv": _MAP_OF_ONE}, needed=False),
    Reader("g2o", "e.g2o", read_g2o, _SLAM, (_G2O,), _G2O_WORDS),
    Reader("tum", "e.tum", read_tum, _SLAM,
           (b"# a comment\n0 0 0 0 0 0 0 1\n1 0.5 0 0 0 0 0.1 0.995\n",), NUMBERS),
)  # fmt: skip
