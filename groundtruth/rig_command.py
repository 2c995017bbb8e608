"""What ``groundtruth rig`` does: reads runs, estimates the rig, puts it into the robot's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from camera import Camera, read_camera
from groundtruth.bundle import mean_pose
from groundtruth.calibration import Network, Rig, read_network, read_rig, write_rig
from groundtruth.cli import Rig as RigCommand
from groundtruth.commands import (
    check_outputs,
    print_rig_sigmas,
    print_table,
    progress,
    provenance,
    residual_figures,
)
from groundtruth.covariance import inverse_covariance
from groundtruth.errors import GroundTruthError
from groundtruth.rig_estimation import (
    RigEstimate,
    estimate_rig,
    moved_rig,
    robot_from_known_markers,
)
from groundtruth.session import MarkerFrame, group_by_time, read_marker_frames
from groundtruth.settings import PoseSettings
from groundtruth.streams import PlanarPoses, read_planar_poses
from groundtruth.track import track_robot
from groundtruth.transforms import inverse, planar_transform
from storage import write_whole

if TYPE_CHECKING:
    FloatArray = NDArray[np.float64]

# A reference pose without covariance is taken to be this good (m, rad), and to stand this level.
_REFERENCE_SIGMA_M, _REFERENCE_SIGMA_RAD = 0.005, 0.005


def make_rig(command: RigCommand) -> int:
    """Carry out ``groundtruth rig``; returns the exit code."""
    if command.robot is not None and command.reference_poses is not None:
        raise GroundTruthError("--robot and --reference-poses both define the robot's frame")
    if command.reference_poses is not None and command.network is None:
        raise GroundTruthError("--reference-poses needs --network: where the cameras are")
    picture = command.picture if command.picture is not None else command.output.with_suffix(".png")
    check_outputs((command.output, picture), command.force)
    cameras, poses, groups, network = _input(command)
    dictionary, widths = _markers(command, groups)
    with progress("rig"):
        estimate = estimate_rig(
            groups,
            cameras,
            poses,
            widths,
            dictionary,
            command.settings,
            reference=command.reference,
        )
    rig, frame = _in_robot_frame(command, estimate, groups, network)
    table = [
        {"marker": marker, **residual_figures(estimate.adjusted, _views_of(estimate, index))}
        for index, marker in enumerate(rig.ids)
    ]
    pairs = [
        {
            "markers": [rig.ids[a], rig.ids[b]],
            "times": len(pair.agrees),
            "agree": pair.support,
            "agree_with_second_solution": int((pair.agrees & ~pair.first).sum()),
        }
        for (a, b), pair in sorted(estimate.pairs.items())
    ]
    extra: dict[str, Any] = {
        "made_by": provenance(command.settings),
        "frame": frame,
        "times": estimate.times,
        "reduced_cost": estimate.adjusted.reduced_cost,
        "residuals": table,
        "pairs": pairs,
    }
    from groundtruth.rig_picture import draw_rig

    drawn = draw_rig(estimate, rig)
    write_rig(command.output, rig, extra, overwrite=command.force)
    with write_whole(picture, overwrite=command.force) as stream:
        stream.write(drawn)
    for marker, reason in estimate.left_out.items():
        print(f"marker {marker}: left out: {reason}")
    print_table(table)
    print_rig_sigmas(replace(estimate, rig=rig))
    print(
        f"{command.output}: {len(rig.ids)} markers from {estimate.times} times, frame: {frame}, "
        f"squared residuals per degree of freedom {estimate.adjusted.reduced_cost:.2f}"
    )
    return 0


def _input(
    command: RigCommand,
) -> tuple[tuple[Camera, ...], FloatArray, list[tuple[MarkerFrame, ...]], Network | None]:
    """Cameras, their poses (identities without a network), images grouped by time, the network."""
    if command.network is not None:
        from groundtruth.commands import read_all_frames

        network = read_network(command.network)
        frames = read_all_frames(command.runs, network)
        groups = group_by_time(frames, command.settings.time_tolerance_s)
        return network.cameras, network.world_from_camera, groups, network
    cameras = []
    alone: list[tuple[MarkerFrame, ...]] = []
    for index, run in enumerate(command.runs):
        cameras.append(read_camera(_calibration(run)))
        alone += [(frame,) for frame in read_marker_frames(run, index, timed=False)]
    return tuple(cameras), np.tile(np.eye(4), (len(cameras), 1, 1)), alone, None


def _calibration(run: Path) -> Path:
    own = run / f"{run.resolve().name}.cam"
    found = sorted(run.glob("*.cam"))
    if own in found:
        return own
    if len(found) != 1:
        raise GroundTruthError(f"{run}: {len(found)} calibrations: expected one .cam file")
    return found[0]


def _markers(
    command: RigCommand, groups: Sequence[Sequence[MarkerFrame]]
) -> tuple[str, dict[int, float]]:
    """The dictionary, and the widths of the markers that may be on the robot."""
    markers = [marker for group in groups for frame in group for marker in frame.markers]
    dictionaries = sorted({marker.dictionary for marker in markers})
    if command.dictionary is None and len(dictionaries) != 1:
        raise GroundTruthError(
            f"markers of the dictionaries {dictionaries}: name the robot's by --dictionary"
        )
    dictionary = command.dictionary if command.dictionary is not None else dictionaries[0]
    found = {marker.id for marker in markers if marker.dictionary == dictionary}
    ids = sorted(found & set(command.ids)) if command.ids else sorted(found)
    if not ids:
        raise GroundTruthError(f"no markers of the dictionary {dictionary} in any of the runs")
    if not (np.isfinite(command.width_m) and command.width_m > 0.0):
        raise GroundTruthError(f"width_m is {command.width_m:g}: expected metres above 0")
    widths = dict.fromkeys(ids, command.width_m)
    for word in command.widths:
        marker, _, width = word.partition("=")
        try:
            number, metres = int(marker), float(width)
        except ValueError:
            number, metres = -1, float("nan")
        if number < 0 or not metres > 0.0:
            raise GroundTruthError(f"widths: {word!r}: expected a marker and metres, as 31=0.15")
        if number in widths:
            widths[number] = metres
    return dictionary, widths


def _views_of(estimate: RigEstimate, index: int) -> list[int]:
    return [i for i, view in enumerate(estimate.views) if view.rig_index == index]


def _in_robot_frame(
    command: RigCommand,
    estimate: RigEstimate,
    groups: Sequence[Sequence[MarkerFrame]],
    network: Network | None,
) -> tuple[Rig, str]:
    """The rig in the robot's frame, and what that is."""
    if command.robot is not None:
        known = read_rig(command.robot)
        pose, covariance, _ = robot_from_known_markers(estimate.rig, known)
        return moved_rig(estimate.rig, pose, covariance), f"robot, by {command.robot.name}"
    if command.reference_poses is None or network is None:
        return estimate.rig, f"marker {estimate.reference}"
    reference = read_planar_poses(command.reference_poses)
    pose, covariance, used = robot_from_reference_poses(
        estimate.rig, groups, network, reference, command.settings.time_tolerance_s
    )
    name = command.reference_poses.name
    return moved_rig(estimate.rig, pose, covariance), f"robot, by {used} poses of {name}"


def robot_from_reference_poses(
    rig: Rig,
    groups: Sequence[Sequence[MarkerFrame]],
    network: Network,
    reference: PlanarPoses,
    tolerance_s: float,
) -> tuple[FloatArray, FloatArray, int]:
    """The robot's frame from times at which its pose is known and it stands level.

    Parameters
    ----------
    rig : Rig
        In any frame.
    groups : sequence of sequences of MarkerFrame
    network : Network
    reference : PlanarPoses
        Known poses; covariances weight them.
    tolerance_s : float
        By how much an image's time may differ from a pose's.

    Returns
    -------
    (4, 4) array
        `robot_from_rig`.
    (6, 6) array
        Covariance of its right perturbation, scaled by how the poses differ.
    int
        How many of the poses were used.

    Raises
    ------
    GroundTruthError
        If there is no image with the rig at the time of any of the poses.
    """
    near = [
        frame
        for group in groups
        for frame in group
        if np.abs(reference.times_s - frame.time_s).min() <= tolerance_s
    ]
    track = track_robot(near, rig, network, PoseSettings(time_tolerance_s=tolerance_s))
    poses, covariances = [], []
    for time_s, candidate in track.posed:
        k = int(np.argmin(np.abs(reference.times_s - time_s)))
        x, y, theta = reference.poses[k]
        world_from_robot = planar_transform(float(x), float(y), float(theta))
        poses.append(inverse(world_from_robot) @ candidate.world_from_robot)
        # The reference's own error is in the robot's axes, which are those of the result's left.
        own = np.diag(np.square([_REFERENCE_SIGMA_M] * 3 + [_REFERENCE_SIGMA_RAD] * 3))
        if reference.covariances is not None:
            turn = world_from_robot[:2, :2].T
            planar = reference.covariances[k]
            own[:2, :2] = turn @ planar[:2, :2] @ turn.T
            own[:2, 5] = turn @ planar[:2, 2]
            own[5, :2] = own[:2, 5]
            own[5, 5] = planar[2, 2]
        moved = inverse_covariance(inverse(poses[-1]), own)
        covariances.append(moved + candidate.covariance)
    if not poses:
        raise GroundTruthError("no image shows the rig at the time of any reference pose")
    pose, covariance, spread = mean_pose(poses, np.stack(covariances))
    return pose, covariance * max(1.0, spread), len(poses)
