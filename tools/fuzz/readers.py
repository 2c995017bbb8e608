"""Every reader of files that strangers make, with files that it accepts, for fuzzing.

What a reader may do with a file is give a result, or raise a typed error whose message names the
file, fits on one line, is of bounded length and shows nothing that a terminal would act upon.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from camera import CameraError, format_camera, parse_camera, read_camera
from detect.errors import DetectError
from detect.image_header import claimed_size
from detect.sources.times import TimesByImage
from detect.sources.tum import TumTrajectory
from groundtruth.boards_file import read_boards
from groundtruth.building import read_building
from groundtruth.calibration import read_network, read_rig
from groundtruth.clock import read_clock
from groundtruth.errors import GroundTruthError
from groundtruth.fiducials import Survey, read_distances, read_survey
from groundtruth.ptpd import read_ptpd
from groundtruth.scanners import read_robot, read_scanners
from groundtruth.scans import read_scans
from groundtruth.streams import read_planar_poses, read_rows_of_numbers, read_times
from landmarks import LandmarkError, frames_of_rows, read_rows
from landmarks.map_file import read_map, read_path
from landmarks.tilts import read_tilts
from slam.errors import SlamError
from slam.g2o_reading import read_g2o
from slam.map_covariance import covariance_file, read_joint_covariance
from slam.tum import read_tum

#: Characters of a message beside the file's name.
LONGEST_MESSAGE = 500


@dataclass(frozen=True)
class Reader:
    """A reader and what fuzzing it begins with.

    Attributes
    ----------
    name : str
    file : str
        What the file is called.
    read : callable
        Reads a file; what else it demands of the result it asserts.
    errors : tuple of exception types
        What it may raise.
    seeds : tuple of bytes
        Files that it accepts.
    words : tuple of bytes
        Words of its language, for those who put files together.
    beside : mapping of str to bytes
        Other files that it needs in the same folder.
    """

    name: str
    file: str
    read: Callable[[Path], object]
    errors: tuple[type[Exception], ...]
    seeds: tuple[bytes, ...]
    words: tuple[bytes, ...] = ()
    beside: Mapping[str, bytes] = field(default_factory=dict)


def attempt(reader: Reader, path: Path) -> Exception | None:
    """Let a reader read a file: its typed error, if any; whatever else it raises escapes.

    Raises
    ------
    AssertionError
        If the error's message is none that a user can read in safety.
    """
    try:
        reader.read(path)
    except reader.errors as error:
        message = str(error)
        assert path.name in message or str(path.parent) in message, "names no file"
        beside_name = message.replace(str(path), "")
        assert message.isprintable(), f"control characters in a message: {message!a}"
        assert len(beside_name) <= LONGEST_MESSAGE, f"message of {len(beside_name)} characters"
        return error
    return None


def _landmarks(path: Path) -> object:
    """Frames of a file; what was accepted is given back byte by byte, and its records too."""
    from landmarks import parse_rows
    from landmarks.writing import format_record

    rows = list(read_rows(path))
    assert b"".join(row.source or b"" for row in rows) == path.read_bytes(), "round trip"
    frames = list(frames_of_rows(rows))
    # Only a file's first row may begin with a byte order mark that is none of its words.
    again = "#\n" + "".join(f"{format_record(r.record)}\n" for r in rows if r.record is not None)
    encoded = again.encode("utf-8", "surrogateescape")
    once = [row.record for row in parse_rows(io.BytesIO(encoded)) if row.record is not None]
    twice = "#\n" + "".join(f"{format_record(record)}\n" for record in once)
    assert len(once) == sum(row.record is not None for row in rows), "records lost in writing"
    assert twice == again, "written records change when they are read"
    return frames


def _camera(path: Path) -> object:
    camera = read_camera(path)
    again = parse_camera(format_camera(camera))
    assert again == camera, "a camera changes when it is written and read"
    return camera


def _header(path: Path) -> object:
    size = claimed_size(path.read_bytes())
    assert size is None or (len(size) == 2 and all(type(side) is int for side in size))
    return size


def _survey() -> Survey:
    points = {"p": np.array([0.0, 1.0]), "q": np.array([1.0, 1.0])}
    return Survey(points, points, 0.01)


def _npz(**arrays: object) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def _npy(array: object) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.asarray(array))
    return stream.getvalue()


def _gzip(text: bytes) -> bytes:
    import gzip

    return gzip.compress(text, mtime=0)


_CAMERA_TEXT = b"""{ SmRadialDistortedCamera
sensor2Tcp: [ 0.99992, -0.00994383, -0.00778315, -0.0820676 ]
[ 0.00718218, -0.0591054, 0.998226, 0.142944 ]
[ -0.0103862, -0.998202, -0.0590291, 0.0522051 ]
sensor2World: [ -0.99992, 0.00994383, 0.00778315, 0.0179777 ]
[ -0.00211987, 0.475426, -0.879753, -0.0808609 ]
[ -0.0124484, -0.879699, -0.475367, 1.50354 ]
mountIndex: 0
width: 768 height: 288 scaleX: 464.762 scaleY: 232.381 offsetX: 384 offsetY: 144
coef: { -0.0620672 -0.324903 0.314764 1.52524 -0.480806 }
}
"""
_STEP = b"STEP e.0000  0.00088 -0.15647  0.01153 1e-5 0 1e-5 0 0 1e-4\n"
_CIRCLE = b"LANDMARK_C 0.31 -2.5 0.81 0.0016 1e-5 0.0021 17\n"
_LINE = b"LANDMARK_L 0.1 -0.2 0.1 0.3 0.02 0.001 0 0.002 -1\n"
_MARKER = b"LANDMARK_M rawseeds 3 0.99" + b" 10 20 0.1 0 0.1" * 4 + b"\n"
_SETTINGS = b"CIRCLEMARKDETECTOR e.cam nohalf 0.1 0.6\n"
_IDENTITY_4 = "1 0 0 1 0 1"
_G2O = f"""# AXES robotics
VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 0.5 0 0.1
VERTEX_XY 12 1 1
EDGE_SE2 0 1 0.5 0 0.1 {_IDENTITY_4}
EDGE_SE2_XY 1 12 0.5 1 4 0 4
# FRAME 1 e.0000 0.5
FIX 0
""".encode()
_POSE_JSON = '"translation_m": [0, 0, 1], "quaternion_xyzw": [0, 0, 0, 1]'
_RIG_JSON = (
    f'{{"dictionary": "rawseeds", "markers": {{"3": {{"width_m": 0.1, {_POSE_JSON}MORE}}}}}}'
)
_SCANNER_JSON = (
    '{"name": "a", "pose": [0, 0, 0.5], "pose_sigma": [0.1, 0.1, 0.1], "first_angle_rad": -1.5,'
    ' "angle_step_rad": 0.01, "readings": 181, "max_range_m": 30, "sigma_m": 0.01}'
)
_CLOCK_JSON = (
    '{"segments": [{"from_s": 0, "to_s": 10, "reference_s": 5, "offset_s": 0.1, "rate": 1.0,'
    ' "angle_rad": 0.1, "sigma_offset_s": 0.001, "sigma_rate": 1e-5, "sigma_angle_rad": null,'
    ' "turned_rad": 3, "status": "ok", "note": ""}]}'
)
_BOARDS_JSON = (
    '{"boards": {"world": {"columns": 3, "rows": 4, "square_m": 0.11}}, "world_from_board": {'
    + _POSE_JSON
    + '}, "images": [{"camera": "a", "placement": 0, "board": "world",'
    f' "corners": {[[u, v] for v in range(4) for u in range(3)]}}}]}}'
)
_MAP_HEAD = "kind,id,x_m,y_m,cxx_m2,cxy_m2,cyy_m2,rows\n"
_MAP = _MAP_HEAD + "disc,3,1.0,2.0,0.01,0.0,0.01,5\nline,-1,1.5,2.0,0.01,0.001,0.01,2\n"
_PATH = "# by hand\nprefix,x_m,y_m,theta_rad\nstart,0,0,0\ne.0001,0.1,-0.2,3\n"
_JSON_WORDS = (b"[", b"]", b"{", b"}", b'"', b":", b"null", b"true", b"1e999", b"NaN", b"-0")
_NUMBERS = (b"nan", b"inf", b"1e308", b"-1e-320", b"1_0", b"0x1", b",", b"#", b"\\", b"\x1b[2J")
_DXF = (
    b"0 SECTION 2 HEADER 9 $ACADVER 1 AC1009 9 $INSUNITS 70 6 0 ENDSEC 0 SECTION 2 ENTITIES "
    b"0 LINE 8 WALLS 10 0.0 20 0.0 30 0.0 11 5.0 21 1.0 31 0.0 "
    b"0 CIRCLE 8 WALLS 10 1.0 20 1.0 30 0.0 40 2.0 0 ENDSEC 0 EOF"
).replace(b" ", b"\n")
_PTPD = (
    b"# Timestamp, State, Clock ID, One Way Delay, Offset From Master, Observed Drift\n"
    b"2009-03-10 12:00:00.500000, slv, x, 0.0001, -0.000012, 1200\n"
    b"1236686400.1 (ptpd debug) offset from master:      0s     -12345ns\n"
    b"(ptpd debug) observed drift:       1200\n"
)
_RAWSEEDS = b"0.1,1,2,0.5," + b",".join([b"0.01", b"0", b"0"] * 3) + b"\n"
_MAP_OF_ONE = (_MAP_HEAD + "disc,3,1.0,2.0,0.01,0.0,0.01,5\n").encode()


_JPEG = b"\xff\xd8\xff\xe0\0\x04AB\xff\xc0\0\x0b\x08\0\x08\0\x08\x01\x01\x11\0\xff\xd9"
_TIFF = b"II*\0\x08\0\0\0\x02\0" + b"".join(
    struct.pack("<HHII", tag, 3, 1, 8) for tag in (256, 257)
) + bytes(4)  # fmt: skip


def _joint(path: Path) -> object:
    map_file = path.parent / "map.csv"
    assert covariance_file(map_file).name == path.name
    return read_joint_covariance(map_file, read_map(map_file))


READERS: tuple[Reader, ...] = (
    Reader(
        "image header",
        "image",
        _header,
        (),
        (
            _JPEG,
            b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x08\0\0\0\x08\x08\0\0\0\0",
            b"P5 8 8 255\n",
            b"BM" + bytes(12) + struct.pack("<Iii", 40, 8, 8),
            _TIFF,
        ),
        (
            b"\xff\xd8",
            b"\xff\xc0",
            b"\xff\xff",
            b"II*\0",
            b"MM\0*",
            b"II+\0",
            b"MM\0+",
            b"P5",
            b"#",
        ),
    ),
    Reader(
        "trajectory",
        "e.tum",
        lambda p: list(TumTrajectory(p, "robotics")),
        (DetectError,),
        (b"# t x y z qx qy qz qw\n0 0 0 0 0 0 0 1\n1 0.5 0 0 0 0 0.1 0.995\n",),
        _NUMBERS,
    ),
    Reader(
        "image times",
        "e.times",
        TimesByImage,
        (DetectError,),
        (b"e.0000 0.1\ne.0001 0.2\n",),
        _NUMBERS,
    ),
    Reader(
        "camera",
        "e.cam",
        _camera,
        (CameraError,),
        (_CAMERA_TEXT,),
        (b"sensor2World:", b"coef:", b"width:", b"{", b"}", b"[", b"]", b"key: value", *_NUMBERS),
    ),
    Reader(
        "landmarks",
        "e.circles",
        _landmarks,
        (LandmarkError,),
        (
            _SETTINGS + _STEP + _CIRCLE + _LINE + _MARKER,
            _STEP + b"# c \\\n" + _CIRCLE[:20] + b"\\\n" + _CIRCLE[20:].replace(b"\n", b"\r\n"),
            b"\xef\xbb\xbf" + _STEP,
        ),
        (
            b"STEP",
            b"LANDMARK",
            b"LANDMARK_C",
            b"LANDMARK_L",
            b"LANDMARK_M",
            b"XDETECTOR",
            b"\\\n",
            b"\r\n",
            *_NUMBERS,
        ),
    ),
    Reader(
        "tilts",
        "e.tilt",
        read_tilts,
        (LandmarkError,),
        (b"# x\nTILT e.0000 0.01 -0.02 1e-6 0 1e-6 9\nNOTILT e.0001 2\n",),
        (b"TILT", b"NOTILT", *_NUMBERS),
    ),
    Reader(
        "map",
        "map.csv",
        read_map,
        (LandmarkError,),
        (_MAP.encode(),),
        (b"disc,", b"line,", b'"', *_NUMBERS),
    ),
    Reader(
        "path",
        "path.csv",
        read_path,
        (LandmarkError,),
        (_PATH.encode(),),
        (b"start,", b'"', *_NUMBERS),
    ),
    Reader(
        "map covariance",
        covariance_file(Path("map.csv")).name,
        _joint,
        (SlamError,),
        (_npy(0.01 * np.eye(2)),),
        (b"NUMPY", b"'descr': '|O'", b"(2, 2)"),
        {"map.csv": _MAP_OF_ONE},
    ),
    Reader(
        "g2o",
        "e.g2o",
        read_g2o,
        (SlamError,),
        (_G2O,),
        (
            b"VERTEX_SE2 ",
            b"VERTEX_XY ",
            b"EDGE_SE2 ",
            b"EDGE_SE2_XY ",
            b"FIX ",
            b"# FRAME ",
            *_NUMBERS,
        ),
    ),
    Reader(
        "tum",
        "e.tum",
        read_tum,
        (SlamError,),
        (b"# AXES robotics\n0 0 0 0 0 0 0 1\n1 0.5 0 0 0 0 0.1 0.995\n",),
        _NUMBERS,
    ),
    Reader(
        "poses",
        "laser.csv",
        read_planar_poses,
        (GroundTruthError,),
        (_RAWSEEDS, b"0 1 2 3\n1 1 2 3\n"),
        _NUMBERS,
    ),
    Reader(
        "times",
        "a.times",
        read_times,
        (GroundTruthError,),
        (b"e.0000 0.1\ne.0001 0.2\n",),
        _NUMBERS,
    ),
    Reader(
        "rows",
        "rows.csv",
        lambda p: read_rows_of_numbers(p, 3, "x, y, z"),
        (GroundTruthError,),
        (b"1,2,3\n4 5 6\n",),
        _NUMBERS,
    ),
    Reader(
        "scans",
        "a.scans.csv",
        lambda p: read_scans(p, 3),
        (GroundTruthError,),
        (b"t,r\n0.1,1,2,3\n0.2,1,2,80\n", b"7 0.1 1 2 3\n"),
        (b"t,", *_NUMBERS),
    ),
    Reader(
        "packed scans",
        "a.scans.csv.gz",
        read_scans,
        (GroundTruthError,),
        (_gzip(b"0.1,1,2,3\n0.2,1,2,80\n"),),
    ),
    Reader(
        "scan arrays",
        "a.scans.npz",
        read_scans,
        (GroundTruthError,),
        (_npz(times_s=np.arange(2.0), ranges_mm=np.ones((2, 3), np.uint16)),),
        (
            b"times_s.npy",
            b"PK\x03\x04",
            b"PK\x01\x02",
            b"'descr': '|O'",
            struct.pack("<I", 0xFFFFFFFF),
        ),
    ),
    Reader(
        "scanners",
        "scanners.json",
        read_scanners,
        (GroundTruthError,),
        (f'{{"version": 1, "scanners": [{_SCANNER_JSON}]}}'.encode(),),
        _JSON_WORDS,
    ),
    Reader(
        "robot",
        "robot.json",
        read_robot,
        (GroundTruthError,),
        (
            f'{{"version": 1, "outline": [[0, 0], [1, 0], [0, 1]], "largest_speed_m_s": 1,'
            f' "largest_turn_rad_s": 2, "scanners": [{_SCANNER_JSON}]}}'.encode(),
        ),
        _JSON_WORDS,
    ),
    Reader(
        "building",
        "building.csv",
        read_building,
        (GroundTruthError,),
        (b"x1_m,y1_m,x2_m,y2_m\n0,0,1,1\n",),
        _NUMBERS,
    ),
    Reader(
        "drawing",
        "building.dxf",
        read_building,
        (GroundTruthError,),
        (_DXF,),
        (
            b"\n0\nLINE\n",
            b"\n0\nINSERT\n",
            b"\n0\nBLOCK\n",
            b"\n0\nSPLINE\n",
            b"\n0\nELLIPSE\n",
            b"\n0\nARC\n",
            b"\n0\nLWPOLYLINE\n",
            b"\n0\nPOLYLINE\n",
            b"\n0\nSEQEND\n",
            b"1e999",
            b"\n70\n",
            b"\n2\n",
            b"BLOCKS",
        ),
    ),
    Reader(
        "survey",
        "fiducials.json",
        read_survey,
        (GroundTruthError,),
        (
            b'{"version": 1, "fiducials": {"p": [0, 1], "q": [1, 1]}, "robot_points": {"a": [0, 1],'
            b' "b": [1, 1]}, "sigma_m": 0.01}',
        ),
        _JSON_WORDS,
    ),
    Reader(
        "distances",
        "distances.csv",
        lambda p: read_distances(p, _survey()),
        (GroundTruthError,),
        (b"pose,t,point,fiducial,distance_m\n0,0.5,p,q,1.25\n",),
        _NUMBERS,
    ),
    Reader(
        "rig",
        "rig.json",
        read_rig,
        (GroundTruthError,),
        (
            _RIG_JSON.replace("MORE", "").encode(),
            _RIG_JSON.replace("MORE", ', "sigmas": [1, 1, 1, 1, 1, 1]').encode(),
        ),
        _JSON_WORDS,
    ),
    Reader(
        "network",
        "network.json",
        read_network,
        (GroundTruthError, CameraError),
        (f'{{"cameras": {{"a": {{"calibration": "a.cam", {_POSE_JSON}}}}}}}'.encode(),),
        _JSON_WORDS,
        {"a.cam": _CAMERA_TEXT},
    ),
    Reader(
        "boards",
        "boards.json",
        read_boards,
        (GroundTruthError, CameraError),
        (_BOARDS_JSON.encode(),),
        (*_JSON_WORDS, b"first", b"second"),
        {"a/a.cam": _CAMERA_TEXT},
    ),
    Reader(
        "clock", "clock.json", read_clock, (GroundTruthError,), (_CLOCK_JSON.encode(),), _JSON_WORDS
    ),
    Reader(
        "ptpd",
        "ptpd.log",
        read_ptpd,
        (GroundTruthError,),
        (_PTPD,),
        (b"offset from master:", b"observed drift:", *_NUMBERS),
    ),
)
