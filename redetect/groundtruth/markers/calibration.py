"""Calibrations on disk: where the markers sit on the robot, where the cameras sit in the world.

``rig.json`` holds `robot_from_marker` for each marker, ``network.json`` `world_from_camera` for
each camera; both may say how uncertain that is (see docs/groundtruth.md).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera import Camera, read_camera
from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import (
    covariance_entry,
    covariance_of,
    is_number,
    numbers,
    read_json,
    write_json,
)
from redetect.groundtruth.trajectories.transforms import quaternion_xyzw, transform_from_quaternion
from redetect.storage.messages import excerpt, one_line

_QUATERNION_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Rig:
    """Square markers on a robot."""

    dictionary: str  # Which set of markers the identifiers are from
    ids: tuple[int, ...]  # The markers, M of them
    widths_m: FloatArray  # (M,): widths of the black squares
    # (M, 4, 4): marker frame: origin at the centre, x right, y up, z out of the printed face
    robot_from_marker: FloatArray
    # (6 M, 6 M): joint covariance of the poses' right perturbations (m, rad); zeros where exactly
    # known.
    covariance: FloatArray

    @property
    def corners(self) -> FloatArray:
        """(M, 4, 3) corners in each marker's frame: top left, right, bottom right, left (m)."""
        return np.stack([marker_corners(width) for width in self.widths_m])


@dataclass(frozen=True, eq=False)
class Network:
    """Cameras fixed in the world."""

    names: tuple[str, ...]  # The cameras, C of them
    # Their calibrations. The mounting that a ``.cam`` file holds means nothing here.
    cameras: tuple[Camera, ...]
    calibrations: tuple[str, ...]  # Their files, relative to the folder of the network's own
    world_from_camera: FloatArray  # (C, 4, 4)
    # (6 C, 6 C): joint covariance of the poses' right perturbations (m, rad); zeros where exactly
    # known.
    covariance: FloatArray


def marker_corners(width_m: float) -> FloatArray:
    """(4, 3) corners in a marker's frame: top left, top right, bottom right, bottom left (m)."""
    half = 0.5 * width_m
    return np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])


def read_rig(path: str | os.PathLike[str]) -> Rig:
    """Read a ``rig.json``.

    Returns
    -------
    Rig
        Markers in the order of their identifiers.

    Raises
    ------
    GroundTruthError
        If the file cannot be read, or an entry is missing or impossible.
    """
    content = read_json(path)
    dictionary = content.get("dictionary")
    if not isinstance(dictionary, str) or not dictionary:
        raise GroundTruthError(f"{path}: dictionary is {excerpt(dictionary)}: expected its name")
    markers = _entries(path, content, "markers")
    try:
        by_id = {int(key): entry for key, entry in markers.items()}
    except ValueError:
        raise GroundTruthError(f"{path}: markers: expected whole numbers as keys") from None
    ids = tuple(sorted(by_id))
    if len(ids) != len(markers) or (ids and ids[0] < 0):
        raise GroundTruthError(f"{path}: markers: expected different IDs of 0 or more")
    widths = []
    for marker in ids:
        width = by_id[marker].get("width_m")
        if not is_number(width) or not width > 0.0:
            raise GroundTruthError(
                f"{path}: marker {marker}: width_m is {excerpt(width)}: expected metres above 0"
            )
        widths.append(float(width))
    poses = np.stack([parse_pose(f"{path}: marker {m}", by_id[m]) for m in ids])
    names = [str(marker) for marker in ids]
    covariance = _joint_covariance(
        str(path), content, "markers", names, [by_id[marker] for marker in ids]
    )
    return Rig(dictionary, ids, np.array(widths), poses, covariance)


def read_network(path: str | os.PathLike[str]) -> Network:
    """Read a ``network.json`` and the calibrations that it names.

    Returns
    -------
    Network
        Cameras in the order of their names.

    Raises
    ------
    GroundTruthError, camera.CameraError
        If a file cannot be read, or an entry is missing or impossible.
    """
    content = read_json(path)
    cameras = _entries(path, content, "cameras")
    names = tuple(sorted(cameras))
    calibrations = []
    paths = []
    for name in names:
        calibration = cameras[name].get("calibration")
        if not isinstance(calibration, str) or not calibration:
            raise GroundTruthError(
                f"{path}: camera {one_line(name, 60)}: calibration is {excerpt(calibration)}: "
                "expected a file"
            )
        # It may well lie beside the network's folder; but only a calibration is ever opened.
        relative = not Path(calibration).is_absolute() and "\0" not in calibration
        if not relative or not calibration.endswith(".cam"):
            raise GroundTruthError(
                f"{path}: camera {one_line(name, 60)}: calibration {excerpt(calibration)} "
                "is no .cam file by a relative path: expected one"
            )
        paths.append(Path(path).parent / calibration)
        calibrations.append(calibration)
    return Network(
        names,
        tuple(read_camera(place) for place in paths),
        tuple(calibrations),
        np.stack(
            [parse_pose(f"{path}: camera {one_line(name, 60)}", cameras[name]) for name in names]
        ),
        _joint_covariance(
            str(path), content, "cameras", list(names), [cameras[name] for name in names]
        ),
    )


def write_rig(
    path: str | os.PathLike[str],
    rig: Rig,
    extra: Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a ``rig.json``; `extra` is written beside the markers (settings, residuals)."""
    entries = {
        str(marker): {"width_m": float(width), **_pose_entries(pose)}
        for marker, width, pose in zip(rig.ids, rig.widths_m, rig.robot_from_marker)
    }
    head = {"dictionary": rig.dictionary}
    content = {**head, **_with_covariance("markers", entries, rig.covariance), **(extra or {})}
    write_json(path, content, overwrite=overwrite)


def write_network(
    path: str | os.PathLike[str],
    network: Network,
    extra: Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a ``network.json``; `extra` is written beside the cameras (settings, residuals)."""
    entries = {
        name: {"calibration": calibration, **_pose_entries(pose)}
        for name, calibration, pose in zip(
            network.names, network.calibrations, network.world_from_camera
        )
    }
    content = {**_with_covariance("cameras", entries, network.covariance), **(extra or {})}
    write_json(path, content, overwrite=overwrite)


def _with_covariance(key: str, entries: dict[str, Any], covariance: FloatArray) -> dict[str, Any]:
    """Entries, and their joint covariance if there is one."""
    content: dict[str, Any] = {key: entries}
    if np.any(covariance):
        content["covariance"] = {key: list(entries), "matrix": covariance.tolist()}
    return content


def _pose_entries(pose: FloatArray) -> dict[str, list[float]]:
    return {
        "translation_m": pose[:3, 3].tolist(),
        "quaternion_xyzw": quaternion_xyzw(pose).tolist(),
    }


def _entries(
    path: str | os.PathLike[str], content: dict[str, Any], key: str
) -> dict[str, dict[str, Any]]:
    entries = content.get(key)
    if not isinstance(entries, dict) or not entries:
        raise GroundTruthError(f"{path}: {key}: expected an object with at least one entry")
    for name, entry in entries.items():
        if not isinstance(entry, dict):
            raise GroundTruthError(f"{path}: {key}: {one_line(name, 60)}: expected an object")
    return entries


def parse_pose(place: str, entry: Any) -> FloatArray:
    """(4, 4) pose of a JSON object with translation_m and quaternion_xyzw."""
    if not isinstance(entry, dict):
        raise GroundTruthError(f"{place}: expected translation_m and quaternion_xyzw")
    translation = numbers(f"{place}: translation_m", entry.get("translation_m"), 3)
    quaternion = numbers(f"{place}: quaternion_xyzw", entry.get("quaternion_xyzw"), 4)
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) <= _QUATERNION_TOLERANCE:
        raise GroundTruthError(
            f"{place}: quaternion_xyzw has length {length:.6g}: expected a unit quaternion"
        )
    return transform_from_quaternion(quaternion / length, translation)


def _joint_covariance(
    path: str, content: dict[str, Any], key: str, names: list[str], entries: list[dict[str, Any]]
) -> FloatArray:
    size = 6 * len(names)
    joint = content.get("covariance")
    single = key.removesuffix("s")
    if joint is None:
        covariance = np.zeros((size, size))
        for i, (name, entry) in enumerate(zip(names, entries)):
            block = slice(6 * i, 6 * i + 6)
            place = f"{path}: {single} {one_line(name, 60)}"
            covariance[block, block] = covariance_entry(place, entry, 6)
        return covariance
    if any("covariance" in entry or "sigmas" in entry for entry in entries):
        raise GroundTruthError(
            f"{path}: covariance for all {key} together and for one of them: expected one of both"
        )
    if not isinstance(joint, dict) or not isinstance(joint.get(key), list):
        raise GroundTruthError(f"{path}: covariance: expected an object with {key} and matrix")
    order = [str(name) for name in joint[key]]
    if sorted(order) != sorted(names):
        raise GroundTruthError(
            f"{path}: covariance: {key} are {excerpt(order)}: expected {excerpt(names)}"
        )
    matrix = covariance_of(f"{path}: covariance", joint.get("matrix"), size)
    index = np.concatenate([6 * order.index(name) + np.arange(6) for name in names])
    return np.asarray(matrix[np.ix_(index, index)])
