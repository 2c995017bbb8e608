"""A session on disk: the images of several cameras, their times, and the markers found in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.markers.adjustment import ChainPoints
from redetect.groundtruth.markers.calibration import Network, Rig, marker_corners
from redetect.groundtruth.markers.refinement import Floor, PoseProblem
from redetect.groundtruth.settings import PoseSettings
from redetect.groundtruth.trajectories.streams import read_times
from redetect.landmarks import MarkerLandmark, read_frames
from redetect.storage.messages import excerpt

DETECTED_NAME = "detected.markers"
NETWORK_NAME = "network.json"
RIG_NAME = "rig.json"

_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".pgm", ".ppm", ".tif", ".tiff", ".bmp")


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


def find_runs(paths: Sequence[Path], network_path: Path | None) -> tuple[list[Path], Path]:
    """The run folders and the network file that a command line means.

    `paths`: a session (a folder with one run folder per camera), or the run folders themselves.
    `network_path`: by default ``network.json`` in the session, or beside the run folders. Returns
    run folders; for a session all that have found markers. the network file.
    """
    for path in paths:
        if not path.is_dir():
            raise GroundTruthError(f"{path}: no such folder: expected a session or a run folder")
    if len(paths) == 1 and not (paths[0] / DETECTED_NAME).is_file():
        runs = sorted(p for p in paths[0].iterdir() if (p / DETECTED_NAME).is_file())
        if not runs:
            raise GroundTruthError(
                f"{paths[0]}: no {DETECTED_NAME} in it or in its folders: "
                "run `detect markers` on each camera's folder first"
            )
        return runs, network_path if network_path is not None else paths[0] / NETWORK_NAME
    beside = paths[0].resolve().parent / NETWORK_NAME
    return list(paths), network_path if network_path is not None else beside


def read_marker_frames(run: Path, camera: int, *, timed: bool = True) -> list[MarkerFrame]:
    """The markers found in a run's images, in the file's order, and the images' times.

    The run folder has ``detected.markers`` and ``<name>.times``. Frames are numbered instead if
    they need not be `timed`.
    """
    times_path = run / f"{run.resolve().name}.times"
    times = _times_by_name(times_path) if timed else {}
    frames = []
    for number, frame in enumerate(read_frames(run / DETECTED_NAME)):
        name = _image_name(frame.step.prefix)
        if timed and name not in times:
            raise GroundTruthError(f"{times_path}: no time of image {frame.step.prefix}")
        time_s = times[name] if timed else float(number)
        frames.append(MarkerFrame(camera, frame.step.prefix, time_s, frame.markers))
    return frames


def group_by_time(
    frames: Sequence[MarkerFrame], tolerance_s: float
) -> list[tuple[MarkerFrame, ...]]:
    """Groups of images of different cameras, in order of time.

    A group's images lie within the tolerance of its first; each camera is in it once.
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
    """The rig's markers among those of some images, in the images' order."""
    index = {marker: i for i, marker in enumerate(rig.ids)}
    return [
        View(frame, marker, index[marker.id])
        for frame in group
        for marker in frame.markers
        if marker.dictionary == rig.dictionary and marker.id in index
    ]


def chain_points(
    views: Sequence[View], widths_m: Sequence[float], corner_floor_px: float
) -> ChainPoints:
    """Corners of views as points of a chain, with body 0 and the rig's markers as parts."""
    cameras = np.repeat([view.frame.camera for view in views], 4).astype(np.int64)
    parts = np.repeat([view.rig_index for view in views], 4).astype(np.int64)
    points = np.zeros((0, 3))
    pixels, covariances = np.zeros((0, 2)), np.zeros((0, 2, 2))
    if views:
        points = np.concatenate([marker_corners(widths_m[view.rig_index]) for view in views])
        corners = [corner for view in views for corner in view.marker.corners]
        pixels = np.array([[c.u, c.v] for c in corners])
        covariances = np.array([[[c.cuu, c.cuv], [c.cuv, c.cvv]] for c in corners])
        covariances += corner_floor_px**2 * np.eye(2)
        determinants = covariances[:, 0, 0] * covariances[:, 1, 1] - covariances[:, 0, 1] ** 2
        wrong = np.flatnonzero(~((covariances[:, 0, 0] > 0.0) & (determinants > 0.0)))
        if wrong.size:
            view = views[int(wrong[0]) // 4]
            raise GroundTruthError(
                f"image {view.frame.prefix}, marker {view.marker.id}: the covariance of a corner "
                "is not positive definite: expected one, or a corner floor above 0"
            )
    return ChainPoints(
        cameras, np.zeros(len(cameras), np.int64), parts, points, pixels, covariances
    )


def pose_problem(
    views: Sequence[View], rig: Rig, network: Network, settings: PoseSettings
) -> PoseProblem:
    """The problem of the robot's pose at one time."""
    tilt = float(np.radians(settings.floor_sigma_tilt_deg))
    floor = Floor(settings.floor_z_m, settings.floor_sigma_z_m, tilt) if settings.floor else None
    return PoseProblem(
        network.cameras,
        network.world_from_camera,
        rig.robot_from_marker,
        network.covariance,
        rig.covariance,
        chain_points(views, rig.widths_m.tolist(), settings.corner_floor_px),
        np.repeat(np.arange(len(views)), 4),
        floor,
    )


def _times_by_name(path: Path) -> dict[str, float]:
    """Times of images by their names without folder and ending, all of them different."""
    times: dict[str, float] = {}
    prefixes: dict[str, str] = {}
    for prefix, time_s in read_times(path).items():
        name = _image_name(prefix)
        if name in prefixes:
            raise GroundTruthError(
                f"{path}: images {excerpt(prefixes[name])} and {excerpt(prefix)} are both "
                f"called {excerpt(name)} without folder and ending: expected different names"
            )
        prefixes[name], times[name] = prefix, time_s
    return times


def _image_name(prefix: str) -> str:
    """An image's name without folder and ending, by which rows and times belong together."""
    name = prefix.strip('"').replace("\\", "/").rsplit("/", 1)[-1]
    for suffix in _IMAGE_SUFFIXES:
        if name.lower().endswith(suffix):
            return name[: -len(suffix)]
    return name
