"""The report's inputs from a session; missing or unreadable files are listed, not raised."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import read_json
from redetect.groundtruth.fusion.clock import ClockModel, PtpdLog, read_clock, read_ptpd
from redetect.groundtruth.lasers.building import find_building, read_building
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    matched_streams,
    moved_poses,
    planar_alignment,
    read_planar_poses,
    segments_between_gaps,
)
from redetect.groundtruth.validation.reference_poses import (
    Dimension,
    SurveyedFiducials,
    read_dimensions,
    read_fiducial_distances,
    read_survey,
    survey_fiducials,
)
from redetect.storage.bounded import read_content

T = TypeVar("T")

#: Streams in the order of the page, with their labels there.
STREAMS = {"laser": "laser", "camera": "cameras", "filtered": "filter alone", "fused": "fused"}
#: Pictures written by commands, by their paths in the session.
PICTURES = ("aligned.png", "validation/errors.png", "validation/scans.png")

_GAP_S = 5.0
_MOST_PICTURE_BYTES = 1 << 24
_PNG = b"\x89PNG\r\n\x1a\n"


@dataclass
class Inputs:
    """All that the page shows."""

    name: str  # Of the session
    building: FloatArray | None = None  # (S, 4)
    streams: dict[str, PlanarPoses] = field(default_factory=dict)  # By the names in `STREAMS`
    odometry: PlanarPoses | None = None  # Aligned with truth, or fused poses, in each visit
    truth: PlanarPoses | None = None
    clock: ClockModel | None = None
    # Contents of `laser.json`, `camera.json`, `fused.json`, ..., by their files' names
    documents: dict[str, dict[str, Any]] = field(default_factory=dict)
    pictures: dict[str, bytes] = field(default_factory=dict)  # By the names in `PICTURES` (PNG)
    dimensions: list[Dimension] = field(default_factory=list)  # Tape measurements
    fiducials: SurveyedFiducials | None = None
    ptpd: PtpdLog | None = None
    visits: list[tuple[float, float]] = field(default_factory=list)  # To the covered area
    missing: list[str] = field(default_factory=list)  # Missing files
    problems: list[str] = field(default_factory=list)  # Files that cannot be read


def gather(session: Path, truth: Path | None = None) -> Inputs:
    """Read a session's files; `truth`: true poses, by default ``truth.csv`` in it, if it exists."""
    if not session.is_dir():
        raise GroundTruthError(f"{session}: no such folder: expected a session")
    inputs = Inputs(session.resolve().name)
    inputs.building = _building(session, inputs)
    # The default output of `groundtruth poses` is poses.csv.
    names = [name for name in ("camera", "poses") if (session / f"{name}.csv").is_file()]
    camera = names[0] if names else "camera"
    for name in STREAMS:
        path = session / f"{camera if name == 'camera' else name}.csv"
        optional = name == "filtered"
        if (stream := _read(inputs, path, read_planar_poses, optional=optional)) is not None:
            inputs.streams[name] = stream
    if truth is not None:
        inputs.truth = read_planar_poses(truth)
    else:
        inputs.truth = _read(inputs, session / "truth.csv", read_planar_poses)
    inputs.clock = _read(inputs, session / "clock.json", read_clock)
    for name in ("aligned", "laser", camera, "clock", "fused", "validation/validation"):
        path, optional = session / f"{name}.json", name in ("clock", camera)
        if (document := _read(inputs, path, read_json, optional=optional)) is not None:
            inputs.documents[path.name] = document
    inputs.visits = _visits(inputs)
    for name in PICTURES:
        if (picture := _read(inputs, session / name, _picture)) is not None:
            inputs.pictures[name] = picture
    inputs.dimensions = _read(inputs, session / "dimensions.csv", read_dimensions) or []
    inputs.fiducials = _read(inputs, session / "fiducial_distances.csv", _surveyed)
    inputs.ptpd = _read(inputs, session / "ptpd.log", read_ptpd)
    inputs.odometry = _odometry(session, inputs)
    return inputs


def in_visits(poses: PlanarPoses, visits: list[tuple[float, float]]) -> PlanarPoses:
    """The poses within visits; all if there are no visits."""
    if not visits:
        return poses
    return poses.only(np.any([poses.during(*visit) for visit in visits], axis=0))


def _read(
    inputs: Inputs, path: Path, reader: Callable[[Path], T], *, optional: bool = False
) -> T | None:
    """The content of a file, or None and a note; no note if a missing file is optional."""
    place = path.name if path.parent.name != "validation" else f"validation/{path.name}"
    try:
        if path.is_file():
            return reader(path)
        if not optional:
            inputs.missing.append(place)
    except (ValueError, OSError) as error:
        problem = str(error).replace(os.fspath(path), place)
        if problem not in inputs.problems:
            inputs.problems.append(problem)
    return None


def _surveyed(path: Path) -> SurveyedFiducials:
    survey = read_survey(path.with_name("fiducials.json"))
    return survey_fiducials(survey, read_fiducial_distances(path, survey))


def _building(session: Path, inputs: Inputs) -> FloatArray | None:
    try:
        path = find_building(session)
    except GroundTruthError:
        inputs.missing.append("building.csv or building.dxf")
        return None
    return _read(inputs, path, read_building)


def _picture(path: Path) -> bytes:
    content = read_content(path, _MOST_PICTURE_BYTES, "picture", GroundTruthError)
    if not content.startswith(_PNG):
        raise GroundTruthError(f"{path}: not a PNG")
    return content


def _visits(inputs: Inputs) -> list[tuple[float, float]]:
    """Intervals with measured ground truth; fused poses also cover the pauses between them."""
    streams = inputs.streams
    measured = [streams[name] for name in ("laser", "camera") if name in streams]
    others = [one for one in (inputs.truth, streams.get("fused")) if one is not None]
    measured = measured or others[:1]
    if not measured:
        return []
    times = np.sort(np.concatenate([stream.times_s for stream in measured]))
    parts = [times[s] for s in segments_between_gaps(times, _GAP_S)]
    return [(float(part[0]), float(part[-1])) for part in parts]


def _odometry(session: Path, inputs: Inputs) -> PlanarPoses | None:
    """Odometry for comparison: on the ground truth's clock, aligned with the truth by visit."""
    odometry = _read(inputs, session / "odometry.csv", read_planar_poses)
    onto = inputs.truth if inputs.truth is not None else inputs.streams.get("fused")
    if odometry is None or onto is None:
        return None
    try:
        if inputs.clock is not None:
            times = inputs.clock.groundtruth_times(odometry.times_s)
            odometry = PlanarPoses(times, odometry.poses)
    except GroundTruthError as error:
        inputs.problems.append(f"odometry.csv: {error}")
        return None
    parts = []
    for visit in inputs.visits:
        try:
            mine, theirs, _ = matched_streams(in_visits(odometry, [visit]), onto)
            parts.append(moved_poses(mine, planar_alignment(mine, theirs)))
        except GroundTruthError:
            continue  # a visit without odometry, or without truth
    if not parts:
        return None
    return PlanarPoses(
        np.concatenate([part.times_s for part in parts]),
        np.concatenate([part.poses for part in parts]),
    )
