"""Readers of ground truth: poses, scans, clocks, scanners, surveys, calibrations."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np

from camera import CameraError
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion.clock import read_clock, read_ptpd
from redetect.groundtruth.lasers.building import read_building
from redetect.groundtruth.lasers.scanners import read_robot, read_scanners, read_scans
from redetect.groundtruth.markers.boards import read_boards
from redetect.groundtruth.markers.session import read_network, read_rig
from redetect.groundtruth.trajectories.streams import read_planar_poses
from redetect.groundtruth.validation.reference_poses import Survey, read_distances, read_survey
from redetect.groundtruth.validation.scoring import read_relations
from tools.fuzz.reader import CAMERA_TEXT, JSON_WORDS, NPZ_WORDS, NUMBERS, Reader, npz

_POINTS = {"p": np.array([0.0, 1.0]), "q": np.array([1.0, 1.0])}
_SURVEY = Survey(_POINTS, _POINTS, 0.01)
_POSE_JSON = '"translation_m": [0, 0, 1], "quaternion_xyzw": [0, 0, 0, 1]'
_RIG_JSON = (
    f'{{"dictionary": "rawseeds", "markers": {{"3": {{"width_m": 0.1, {_POSE_JSON},'
    ' "sigmas": [1, 1, 1, 1, 1, 1]}}}'
)
_SCANNER_JSON = (
    '{"name": "a", "pose": [0, 0, 0.5], "pose_sigma": [0.1, 0.1, 0.1], "first_angle_rad": -1.5,'
    ' "angle_step_rad": 0.01, "readings": 181, "max_range_m": 30, "sigma_m": 0.01}'
)
_CLOCK_JSON = (
    '{"segments": [{"from_s": 0, "to_s": 10, "reference_s": 5, "offset_s": 0.1, "rate": 1.0,'
    ' "angle_rad": 0.1, "sigma_offset_s": 0.001, "sigma_rate": 1e-5,'
    ' "turned_rad": 3, "status": "ok", "note": ""}]}'
)
_BOARDS_JSON = (
    '{"boards": {"world": {"columns": 3, "rows": 4, "square_m": 0.11}}, "world_from_board": {'
    + _POSE_JSON
    + '}, "images": [{"camera": "a", "placement": 0, "board": "world", "image": "a/0.png"}]}'
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
_RAWSEEDS = b"0.1,1,2,0.5,0.01,0,0,0,0.01,0,0,0,0.01\n"


def _reader(
    name: str, file: str, read: Callable[[Path], object], *seeds: bytes,
    words: tuple[bytes, ...] = NUMBERS, beside: str = "",
) -> Reader:  # fmt: skip
    """A reader of this package; `beside` names a calibration that its file needs."""
    errors = (GroundTruthError, CameraError) if beside else (GroundTruthError,)
    return Reader(name, file, read, errors, seeds, words, {beside: CAMERA_TEXT} if beside else {})


_DXF_WORDS = (
    *(f"\n0\n{kind}\n".encode() for kind in (
        "LINE", "INSERT", "BLOCK", "SPLINE", "ELLIPSE", "ARC", "LWPOLYLINE", "POLYLINE", "SEQEND",
    )),
    b"1e999", b"\n70\n", b"\n2\n", b"BLOCKS",
)  # fmt: skip
_SCAN_ARRAYS = npz(times_s=np.arange(2.0), ranges_mm=np.ones((2, 3), np.uint16))
_SCANNERS_JSON = f'{{"version": 1, "scanners": [{_SCANNER_JSON}]}}'
_ROBOT_JSON = (
    '{"version": 1, "outline": [[0, 0], [1, 0], [0, 1]], "largest_speed_m_s": 1,'
    f' "largest_turn_rad_s": 2, "scanners": [{_SCANNER_JSON}]}}'
)
_SURVEY_JSON = (
    '{"version": 1, "fiducials": {"p": [0, 1], "q": [1, 1]}, "robot_points": {"a": [0, 1],'
    ' "b": [1, 1]}, "sigma_m": 0.01}'
)
_NETWORK_JSON = f'{{"cameras": {{"a": {{"calibration": "a.cam", {_POSE_JSON}}}}}}}'

GROUNDTRUTH_READERS: tuple[Reader, ...] = (
    _reader("poses", "laser.csv", read_planar_poses, _RAWSEEDS, b"0 1 2 3\n1 1 2 3\n"),
    _reader("relations", "relations.csv", read_relations,
            b"0,1,0.5,0,0,0,0,0.1\n0 1 0.5 0 0 0 0 0.1\n"),
    _reader("scans", "a.scans.csv", lambda p: read_scans(p, 3), b"t,r\n0.1,1,2,3\n0.2,1,2,80\n",
            b"7 0.1 1 2 3\n", words=(b"t,", *NUMBERS)),
    _reader("packed scans", "a.scans.csv.gz", read_scans,
            gzip.compress(b"0.1,1,2,3\n0.2,1,2,80\n", mtime=0), words=()),
    _reader("scan arrays", "a.scans.npz", read_scans, _SCAN_ARRAYS,
            words=(b"times_s.npy", *NPZ_WORDS)),
    _reader("scanners", "scanners.json", read_scanners, _SCANNERS_JSON.encode(), words=JSON_WORDS),
    _reader("robot", "robot.json", read_robot, _ROBOT_JSON.encode(), words=JSON_WORDS),
    _reader("building", "building.csv", read_building, b"x1_m,y1_m,x2_m,y2_m\n0,0,1,1\n"),
    _reader("drawing", "building.dxf", read_building, _DXF, words=_DXF_WORDS),
    _reader("survey", "fiducials.json", read_survey, _SURVEY_JSON.encode(), words=JSON_WORDS),
    _reader("distances", "distances.csv", lambda p: read_distances(p, _SURVEY),
            b"pose,t,point,fiducial,distance_m\n0,0.5,p,q,1.25\n"),
    _reader("rig", "rig.json", read_rig, _RIG_JSON.encode(), words=JSON_WORDS),
    _reader("network", "network.json", read_network, _NETWORK_JSON.encode(), words=JSON_WORDS,
            beside="a.cam"),
    _reader("boards", "boards.json", read_boards, _BOARDS_JSON.encode(),
            words=(*JSON_WORDS, b"first", b"second"), beside="a/a.cam"),
    _reader("clock", "clock.json", read_clock, _CLOCK_JSON.encode(), words=JSON_WORDS),
    _reader("ptpd", "ptpd.log", read_ptpd, _PTPD,
            words=(b"offset from master:", b"observed drift:", *NUMBERS)),
)  # fmt: skip
