"""Readers of where a robot really was: poses, scans, clocks, scanners, surveys, calibrations."""

from __future__ import annotations

import io
import struct

import numpy as np

from camera import CameraError
from redetect.groundtruth.clocks.clock import read_clock
from redetect.groundtruth.clocks.ptpd import read_ptpd
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.building import read_building
from redetect.groundtruth.lasers.scanners import read_robot, read_scanners
from redetect.groundtruth.lasers.scans import read_scans
from redetect.groundtruth.markers.boards_file import read_boards
from redetect.groundtruth.markers.calibration import read_network, read_rig
from redetect.groundtruth.trajectories.streams import (
    read_planar_poses,
    read_rows_of_numbers,
    read_times,
)
from redetect.groundtruth.validation.fiducials import Survey, read_distances, read_survey
from redetect.groundtruth.validation.relative_errors import read_relations
from tools.fuzz.reader import Reader
from tools.fuzz.words import CAMERA_TEXT, JSON_WORDS, NUMBERS


def _survey() -> Survey:
    points = {"p": np.array([0.0, 1.0]), "q": np.array([1.0, 1.0])}
    return Survey(points, points, 0.01)


def _npz(**arrays: object) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def _gzip(text: bytes) -> bytes:
    import gzip

    return gzip.compress(text, mtime=0)


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

GROUNDTRUTH_READERS: tuple[Reader, ...] = (
    Reader(
        "poses",
        "laser.csv",
        read_planar_poses,
        (GroundTruthError,),
        (_RAWSEEDS, b"0 1 2 3\n1 1 2 3\n"),
        NUMBERS,
    ),
    Reader(
        "times",
        "a.times",
        read_times,
        (GroundTruthError,),
        (b"e.0000 0.1\ne.0001 0.2\n",),
        NUMBERS,
    ),
    Reader(
        "rows",
        "rows.csv",
        lambda p: read_rows_of_numbers(p, 3, "x, y, z"),
        (GroundTruthError,),
        (b"1,2,3\n4 5 6\n",),
        NUMBERS,
    ),
    Reader(
        "relations",
        "relations.csv",
        read_relations,
        (GroundTruthError,),
        (b"0,1,0.5,0,0,0,0,0.1\n0 1 0.5 0 0 0 0 0.1\n",),
        NUMBERS,
    ),
    Reader(
        "scans",
        "a.scans.csv",
        lambda p: read_scans(p, 3),
        (GroundTruthError,),
        (b"t,r\n0.1,1,2,3\n0.2,1,2,80\n", b"7 0.1 1 2 3\n"),
        (b"t,", *NUMBERS),
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
        JSON_WORDS,
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
        JSON_WORDS,
    ),
    Reader(
        "building",
        "building.csv",
        read_building,
        (GroundTruthError,),
        (b"x1_m,y1_m,x2_m,y2_m\n0,0,1,1\n",),
        NUMBERS,
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
        JSON_WORDS,
    ),
    Reader(
        "distances",
        "distances.csv",
        lambda p: read_distances(p, _survey()),
        (GroundTruthError,),
        (b"pose,t,point,fiducial,distance_m\n0,0.5,p,q,1.25\n",),
        NUMBERS,
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
        JSON_WORDS,
    ),
    Reader(
        "network",
        "network.json",
        read_network,
        (GroundTruthError, CameraError),
        (f'{{"cameras": {{"a": {{"calibration": "a.cam", {_POSE_JSON}}}}}}}'.encode(),),
        JSON_WORDS,
        {"a.cam": CAMERA_TEXT},
    ),
    Reader(
        "boards",
        "boards.json",
        read_boards,
        (GroundTruthError, CameraError),
        (_BOARDS_JSON.encode(),),
        (*JSON_WORDS, b"first", b"second"),
        {"a/a.cam": CAMERA_TEXT},
    ),
    Reader(
        "clock", "clock.json", read_clock, (GroundTruthError,), (_CLOCK_JSON.encode(),), JSON_WORDS
    ),
    Reader(
        "ptpd",
        "ptpd.log",
        read_ptpd,
        (GroundTruthError,),
        (_PTPD,),
        (b"offset from master:", b"observed drift:", *NUMBERS),
    ),
)
