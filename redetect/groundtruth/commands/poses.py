"""The command ``groundtruth poses``: a robot's poses from its markers in cameras' images."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np

from redetect.command_line import EXIT_ERROR
from redetect.groundtruth.commands import outputs
from redetect.groundtruth.files import write_json
from redetect.groundtruth.fusion.stream_errors import with_jitter_covered
from redetect.groundtruth.markers import session
from redetect.groundtruth.markers.track import PoseStatus, Track, report_entry, track_by_markers
from redetect.groundtruth.options import Poses
from redetect.groundtruth.trajectories.streams import format_tum, write_planar_poses
from redetect.json_text import json_text
from redetect.messages import counted
from redetect.storage import write_bytes

_Name = TypeVar("_Name", int, str)

#: Share of markers that disagree, or times that have no pose, above which a warning is printed; a
#: marker, or camera, is wrong if more than a share of its views disagree, and hardly any others do.
_MANY_LEFT_OUT, _MOST_LEFT_OUT, _OF_THE_WRONG = 0.1, 0.5, 0.8
#: Squared residuals per degree of freedom above which a warning is printed.
_MUCH_TOO_LARGE = 9.0


def perform(command: Poses) -> int:
    """Carry out ``groundtruth poses``; returns the exit code: 1 without a single pose."""
    runs = session.find_runs(command.session)
    network_path = command.network or command.session / "network.json"
    rig_path = command.rig or command.session / "rig.json"
    output = command.output or command.session / "poses.csv"
    settings_path = output.with_suffix(".json")
    outputs.check_outputs((output, settings_path, command.tum, command.report), command.force)
    network = session.read_network(network_path)
    rig = session.read_rig(rig_path)
    frames = session.read_network_frames(runs, network)
    groups = session.group_by_time(frames, command.settings.time_tolerance_s)
    track = track_by_markers(outputs.progress(groups, "poses"), rig, network, command.settings)
    poses = track.planar()
    print(
        f"{len(poses)} poses of {len(track.times)} times: "
        + ", ".join(f"{number} {status}" for status, number in track.counts.items() if number)
    )
    if track.unknown_markers:
        print(f"ignored: {counted(track.unknown_markers, 'marker')} not on the rig")
        sets = {marker.dictionary for frame in frames for marker in frame.markers}
        if others := sorted(sets - {rig.dictionary}):
            found = f"markers of {', '.join(others)} were found"
            outputs.warn(f"{found}, those in {rig_path} are of {rig.dictionary}")
    print_left_out(track, network, rig_path, network_path)
    if command.report is not None:
        lines = [f"{json_text(report_entry(t, network), indent=None)}\n" for t in track.times]
        write_bytes(command.report, "".join(lines).encode(), overwrite=command.force)
    if not len(poses):
        outputs.remove_old([output, settings_path, command.tum], command.force)
        print("error: no pose", file=sys.stderr)
        return EXIT_ERROR
    print(f"squared residuals per degree of freedom: {track.chi2_per_dof:.2f}")
    if track.chi2_per_dof > _MUCH_TOO_LARGE:
        outputs.warn(
            f"residuals are {track.chi2_per_dof**0.5:.0f} times as large as expected: the "
            f"widths and poses of markers in {rig_path}, the poses of cameras in {network_path}, "
            "or a lens calibration may be wrong"
        )
    poses, jitter = with_jitter_covered(poses)
    if jitter > 1.0:
        outputs.warn(
            f"the poses jitter {jitter:.1f} times as much as their covariances allow, which were "
            f"raised: poses of cameras, in {network_path}, or their clocks may be wrong"
        )
    write_planar_poses(output, poses, overwrite=command.force)
    content = {
        **outputs.provenance(command.settings, (rig_path, network_path)),
        "columns": "t x y theta, covariance of x y theta row by row (s, m, rad)",
        "times": dict(track.counts),
        "reduced_cost": track.chi2_per_dof,
        "jitter_in_deviations": jitter,
    }
    write_json(settings_path, content, overwrite=command.force)
    if command.tum is not None:
        in_space = np.stack([pose.world_from_robot for _, pose in track.posed])
        text = format_tum(poses.times_s, in_space)
        write_bytes(command.tum, text.encode(), overwrite=command.force)
    print(f"{output}: written")
    return 0


def print_left_out(
    track: Track, network: session.Network, rig_path: Path, network_path: Path
) -> None:
    """Say how many markers disagree with others, and what may be wrong if they are many."""
    seen = [
        (view.marker.id, network.names[view.frame.camera], bool(good))
        for tracked in track.times
        if tracked.pose and tracked.estimate
        for view, good in zip(tracked.views, tracked.estimate.views)
    ]
    total, failed = sum(not good for *_, good in seen), track.counts[PoseStatus.FAILED]
    if total:
        print(f"ignored: {counted(total, 'marker')} in disagreement with others at the time")
    if total <= _MANY_LEFT_OUT * len(seen) and failed <= _MANY_LEFT_OUT * len(track.times):
        return
    markers = _wrong((marker, good) for marker, _, good in seen)
    cameras = _wrong((camera, good) for _, camera, good in seen)
    first = f"the pose of marker {', '.join(map(str, markers))}, or else " if markers else ""
    first += f"the pose or clock of camera {', '.join(cameras)}, or else " if cameras else ""
    some = f"{total} of {len(seen)} markers disagree with others; " if seen else ""
    outputs.warn(
        f"{some}{counted(failed, 'time')} without a pose, since the markers disagree: "
        f"{first}poses or widths of markers, in {rig_path}, poses of cameras, in {network_path}, "
        "or their clocks may be wrong"
    )


def _wrong(views: Iterable[tuple[_Name, bool]]) -> list[_Name]:
    """Markers, or cameras, by whether each of their views agrees: those to which nearly all
    disagreements belong, in most of their views.
    """
    seen: Counter[_Name] = Counter()
    left_out: Counter[_Name] = Counter()
    for name, good in views:
        seen[name] += 1
        left_out[name] += not good
    wrong = [name for name, count in left_out.items() if count > _MOST_LEFT_OUT * seen[name]]
    named = sum(left_out[name] for name in wrong) > _OF_THE_WRONG * left_out.total()
    return sorted(wrong) if named else []
