"""The files of a session with markers: rig, network, images and the markers found in them.

``rig.json`` contains `robot_from_marker` of each marker, ``network.json`` `world_from_camera` of
each camera; both may contain covariances (see docs/groundtruth.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from camera import Camera, read_camera
from redetect.array_types import FloatArray
from redetect.bounds import Bounds, whole_number_in
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import JsonObject, PathLike, write_json
from redetect.groundtruth.trajectories import se3
from redetect.landmarks import MarkerLandmark, read_frames
from redetect.landmarks.frame_files import read_times

_QUATERNION_TOLERANCE = 1e-3
#: Widths of markers.
WIDTH = Bounds("metres above 0, at most 10 (200 mm are 0.2)", lambda x: 0.0 < x <= 10.0)
DETECTED_NAME = "detected.markers"


@dataclass(frozen=True, eq=False)
class Rig:
    """Square markers on a robot."""

    dictionary: str  # The set of markers that defines the identifiers
    ids: tuple[int, ...]  # The markers, M of them
    widths_m: FloatArray  # (M,): widths of the black squares
    robot_from_marker: FloatArray  # (M, 4, 4): markers' x right, y up, z out of the print
    covariance: FloatArray  # (6 M, 6 M): of right perturbations (m, rad); zeros if exact

    @property
    def corners(self) -> FloatArray:
        """(M, 4, 3) corners in each marker's frame: top left, right, bottom right, left (m)."""
        return np.stack([marker_corners(width) for width in self.widths_m])


@dataclass(frozen=True, eq=False)
class Network:
    """Cameras fixed in the world."""

    names: tuple[str, ...]  # The cameras, C of them
    cameras: tuple[Camera, ...]  # Their lenses; the mounting in a ``.cam`` file is ignored
    calibrations: tuple[str, ...]  # Their files, relative to the folder of the network's file
    world_from_camera: FloatArray  # (C, 4, 4)
    covariance: FloatArray  # (6 C, 6 C): of right perturbations (m, rad); zeros if exact


def marker_corners(width_m: float) -> FloatArray:
    """(4, 3) corners in a marker's frame: top left, top right, bottom right, bottom left (m)."""
    half = 0.5 * width_m
    return np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])


def read_rig(path: PathLike) -> Rig:
    """Read a ``rig.json``; its markers are returned in the order of their identifiers.

    Raises `GroundTruthError` if the file cannot be read, or an entry is missing or impossible.
    """
    content = JsonObject.read(path)
    dictionary = content.text("dictionary", "its name")
    markers = content.objects("markers")
    try:
        by_id = {whole_number_in(key): entry for key, entry in markers.items()}
    except ValueError:
        raise GroundTruthError(f"{path}: markers: expected whole numbers as keys") from None
    ids = tuple(sorted(by_id))
    if len(ids) != len(markers) or (ids and ids[0] < 0):
        raise GroundTruthError(f"{path}: markers: expected different IDs of 0 or more")
    entries = {str(marker): by_id[marker] for marker in ids}
    widths = np.array([entry.number("width_m", WIDTH) for entry in entries.values()])
    poses = np.stack([parse_pose(entry) for entry in entries.values()])
    return Rig(dictionary, ids, widths, poses, _joint_covariance(content, "markers", entries))


def read_network(path: PathLike) -> Network:
    """Read a ``network.json`` and its cameras' calibrations; cameras are sorted by name.

    Raises `GroundTruthError` or `camera.CameraError` if a file or an entry is not valid.
    """
    content = JsonObject.read(path)
    cameras = dict(sorted(content.objects("cameras").items()))
    calibrations = tuple(entry.text("calibration", "a file") for entry in cameras.values())
    for calibration, entry in zip(calibrations, cameras.values()):
        # It may be outside the network's folder; but only calibrations are ever opened.
        relative = not Path(calibration).is_absolute() and "\0" not in calibration
        if not relative or not calibration.endswith(".cam"):
            raise entry.wrong("calibration", "a .cam file by a relative path")
    return Network(
        tuple(cameras),
        tuple(read_camera(Path(path).parent / calibration) for calibration in calibrations),
        calibrations,
        np.stack([parse_pose(entry) for entry in cameras.values()]),
        _joint_covariance(content, "cameras", cameras),
    )


def write_rig(
    path: PathLike, rig: Rig, extra: Mapping[str, Any] | None = None, *, overwrite: bool = False
) -> None:
    """Write a ``rig.json``; `extra` is written beside the markers (settings, residuals)."""
    entries = {
        str(marker): {"width_m": float(width), **pose_entries(pose)}
        for marker, width, pose in zip(rig.ids, rig.widths_m, rig.robot_from_marker)
    }
    head = {"dictionary": rig.dictionary}
    content = {**head, **_with_covariance("markers", entries, rig.covariance), **(extra or {})}
    write_json(path, content, overwrite=overwrite)


def write_network(
    path: PathLike,
    network: Network,
    extra: Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a ``network.json``; `extra` is written beside the cameras (settings, residuals)."""
    rows = zip(network.names, network.calibrations, network.world_from_camera)
    entries = {
        name: {"calibration": calibration, **pose_entries(pose)} for name, calibration, pose in rows
    }
    content = {**_with_covariance("cameras", entries, network.covariance), **(extra or {})}
    write_json(path, content, overwrite=overwrite)


def _with_covariance(key: str, entries: dict[str, Any], covariance: FloatArray) -> dict[str, Any]:
    """Entries, with their joint covariance if there is one."""
    content: dict[str, Any] = {key: entries}
    if np.any(covariance):
        content["covariance"] = {key: list(entries), "matrix": covariance.tolist()}
    return content


def pose_entries(pose: FloatArray) -> dict[str, list[float]]:
    """A (4, 4) pose in the form that `parse_pose` reads."""
    return {
        "translation_m": pose[:3, 3].tolist(),
        "quaternion_xyzw": se3.quaternion_xyzw(pose).tolist(),
    }


def parse_pose(entry: JsonObject) -> FloatArray:
    """(4, 4) pose of a JSON object with translation_m and quaternion_xyzw."""
    translation = entry.numbers("translation_m", 3)
    quaternion = entry.numbers("quaternion_xyzw", 4)
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) <= _QUATERNION_TOLERANCE:
        raise GroundTruthError(
            f"{entry.place}: quaternion_xyzw has length {length:.6g}: expected a unit quaternion"
        )
    return se3.transform(Rotation.from_quat(quaternion / length).as_matrix(), translation)


def _joint_covariance(
    content: JsonObject, key: str, entries: Mapping[str, JsonObject]
) -> FloatArray:
    """(6 N, 6 N) covariance of all entries' poses, in their order."""
    if "covariance" not in content:
        return np.asarray(block_diag(*(entry.uncertainty(6) for entry in entries.values())))
    if any("covariance" in entry or "sigmas" in entry for entry in entries.values()):
        raise GroundTruthError(
            f"{content.place}: a joint covariance of all {key}, and one of a single entry: "
            "expected only one of them"
        )
    return content.joint_covariance(key, list(entries), 6)


@dataclass(frozen=True)
class MarkerFrame:
    """The markers found in one image."""

    camera: int  # Index of the camera
    prefix: str  # The image's name
    time_s: float
    markers: tuple[MarkerLandmark, ...]


@dataclass(frozen=True)
class View:
    """A marker of the rig in an image."""

    frame: MarkerFrame
    marker: MarkerLandmark
    rig_index: int


def find_runs(session: Path) -> list[Path]:
    """A session's runs with detected markers; raises `GroundTruthError` if there are none."""
    if not session.is_dir():
        raise GroundTruthError(f"{session}: no such folder: expected a session")
    runs = sorted(p for p in session.iterdir() if (p / DETECTED_NAME).is_file())
    if not runs:
        raise GroundTruthError(
            f"{session}: no {DETECTED_NAME} in its folders: run `detect markers` on each camera's "
            "folder first"
        )
    return runs


def read_marker_frames(run: Path, camera: int, *, timed: bool = True) -> list[MarkerFrame]:
    """The markers found in a run's images, in the file's order, and the images' times.

    The run folder contains ``detected.markers`` and ``<name>.times``. Frames are numbered instead
    if not `timed`.
    """
    times_path = run / f"{run.resolve().name}.times"
    times = read_times(times_path) if timed else {}
    frames, at = [], dict[float, str]()
    for number, frame in enumerate(read_frames(run / DETECTED_NAME)):
        prefix = frame.step.prefix
        if timed and prefix not in times:
            raise GroundTruthError(f"{times_path}: no time of image {prefix}")
        time_s = times[prefix] if timed else float(number)
        if (other := at.setdefault(time_s, prefix)) != prefix:
            raise GroundTruthError(
                f"{times_path}: images {other} and {prefix} have one time, {time_s:.6f} s: "
                "expected when each was taken, with all digits"
            )
        frames.append(MarkerFrame(camera, prefix, time_s, frame.markers))
    if not frames:
        raise GroundTruthError(f"{run / DETECTED_NAME}: no STEP row: expected those of images")
    return frames


def read_network_frames(runs: Sequence[Path], network: Network) -> list[MarkerFrame]:
    """The markers found in all runs, whose folders have the names of the network's cameras."""
    frames = []
    for run in runs:
        name = run.resolve().name
        if name not in network.names:
            raise GroundTruthError(
                f"{run}: is not a camera of the network: expected one of {', '.join(network.names)}"
            )
        frames += read_marker_frames(run, network.names.index(name))
    return frames


def group_by_time(
    frames: Sequence[MarkerFrame], tolerance_s: float
) -> list[tuple[MarkerFrame, ...]]:
    """Groups of images of different cameras, in order of time.

    A group's images are within the tolerance of its first; each camera occurs at most once.
    """
    groups: list[list[MarkerFrame]] = []
    for frame in sorted(frames, key=lambda frame: (frame.time_s, frame.camera)):
        near = bool(groups) and frame.time_s - groups[-1][0].time_s <= tolerance_s
        if near and all(frame.camera != other.camera for other in groups[-1]):
            groups[-1].append(frame)
        else:
            groups.append([frame])
    return [tuple(group) for group in groups]


def rig_views(group: Sequence[MarkerFrame], rig: Rig) -> list[View]:
    """The rig's markers among those found in images, in the images' order."""
    index = {marker: i for i, marker in enumerate(rig.ids)}
    return [
        View(frame, marker, index[marker.id])
        for frame in group
        for marker in frame.markers
        if marker.dictionary == rig.dictionary and marker.id in index
    ]
