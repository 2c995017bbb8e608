"""The commands ``groundtruth sync`` and ``fuse``: the clocks, and the path from all poses."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from redetect.command_line import EXIT_ERROR
from redetect.groundtruth.commands.outputs import check_outputs, provenance, remove_old, warn
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import write_json
from redetect.groundtruth.fusion import clock, stream_errors
from redetect.groundtruth.fusion.fuse import Fusion, LeftOut, fuse, leave_out
from redetect.groundtruth.fusion.sync import synchronise
from redetect.groundtruth.options import Fuse, Sync
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    read_planar_poses,
    write_planar_poses,
)
from redetect.messages import counted

_CONFIDENCE = 1.959964
#: Share of a stream's poses above which rejections are warned of.
_MANY_REJECTED = 0.1
#: Largest relative error of turns or distances that wheels may have.
_LARGEST_SCALE = 0.3


def perform_sync(options: Sync) -> int:
    """Carry out ``groundtruth sync``; returns the exit code: 1 if no segment could be aligned."""
    check_outputs([options.output], options.force)
    odometry = read_planar_poses(options.odometry)
    truth = read_planar_poses(options.groundtruth)
    log = None if options.ptpd is None else clock.read_ptpd(options.ptpd)
    segments = synchronise(odometry, truth, options.settings)
    for segment in segments:
        print(_line(segment))
    if not any(segment.is_determined for segment in segments):
        remove_old([options.output], options.force)
        print("error: no segment could be synchronised: no clock file is written", file=sys.stderr)
        return EXIT_ERROR
    document: dict[str, Any] = {
        **provenance(options.settings, [options.odometry, options.groundtruth]),
        "segments": segments,
    }
    if log is not None:
        document["ptpd"] = clock.compare_with_ptpd(clock.ClockModel(segments), log)
        rms, inside = (document["ptpd"][k] for k in ("rms_difference_s", "reports_in_segments"))
        print(
            f"ptpd: {len(log.offset_s)} reports, {inside} compared, "
            + ("none in a segment" if rms is None else f"rms difference {1e3 * rms:.2f} ms")
        )
    write_json(options.output, document, overwrite=options.force)
    return 0


def _line(segment: clock.ClockSegment) -> str:
    head = f"{segment.from_s:.2f} .. {segment.to_s:.2f} s: "
    if not segment.is_determined:
        return head + f"cannot be synchronised: {segment.note}"
    offset = _CONFIDENCE * segment.sigma_offset_s
    drift = _CONFIDENCE * segment.sigma_rate
    text = (
        f"offset {1e3 * segment.offset_s:+.2f} +- {1e3 * offset:.2f} ms, "
        f"drift {1e6 * (segment.rate - 1.0):+.1f} +- {1e6 * drift:.1f} ppm, "
        f"angle {math.degrees(segment.angle_rad):+.3f} deg, "
        f"turned {math.degrees(segment.turned_rad):.0f} deg"
    )
    return head + text + (f" ({segment.status}: {segment.note})" if segment.note else "")


def perform_fuse(options: Fuse) -> int:
    """Carry out ``groundtruth fuse``; returns the exit code."""
    report = options.output.with_suffix(".json")
    check_outputs([options.output, report, options.filtered], options.force)
    named = {"laser": options.laser, "camera": options.camera}
    files: dict[str, Path] = {name: path for name, path in named.items() if path is not None}
    if not files:
        raise GroundTruthError("neither --laser nor --camera: expected at least one ground truth")
    settings = options.settings
    odometry = read_planar_poses(options.odometry)
    if options.clock is not None:
        times = clock.read_clock(options.clock).groundtruth_times(odometry.times_s)
        odometry = PlanarPoses(times, odometry.poses)
    streams = {name: read_planar_poses(path) for name, path in files.items()}
    for name, stream in streams.items():
        if stream.covariances is None:
            raise GroundTruthError(
                f"{files[name]}: no covariances: expected t, x, y, theta and 9 more, as of {name}"
            )
    inputs = [options.odometry, *files.values(), *([options.clock] if options.clock else [])]
    # Errors that the laser's poses have in common do not average out.
    common = np.zeros((3, 3))
    if options.laser is not None:
        known = stream_errors.read_common_covariance(options.laser)
        streams["laser"], common = stream_errors.without_common(streams["laser"], known)
        beside = stream_errors.file_beside(options.laser)
        inputs += [beside] if beside.is_file() else []
    left_out = leave_out(odometry, streams, settings) if options.leave_out else ()
    fusion = fuse(odometry, streams, settings)
    paths = (fusion.poses, fusion.filtered)
    poses, filtered = (stream_errors.with_common(path, common) for path in paths)
    fusion = replace(fusion, poses=poses, filtered=filtered)
    document = {
        **provenance(settings, inputs),
        "used": fusion.used,
        "odometry": fusion.odometry,
        "localisation": fusion.localisation,
        "left_out": left_out,
        stream_errors.COMMON: common.tolist(),
        "covariances_repaired": fusion.repaired,
        "jitter_in_deviations": fusion.jitter,
        "slips_s": fusion.slips_s,
        "restarts_s": fusion.restarts_s,
        "odometry_pauses_s": fusion.pauses_s,
        "odometry_resets_s": fusion.resets_s,
        "rejected": fusion.rejected,
    }
    write_planar_poses(options.output, fusion.poses, overwrite=options.force)
    if options.filtered is not None:
        write_planar_poses(options.filtered, fusion.filtered, overwrite=options.force)
    write_json(report, document, overwrite=options.force)
    _print_summary(options, fusion, left_out)
    return 0


def _print_summary(options: Fuse, fusion: Fusion, left_out: Sequence[LeftOut]) -> None:
    covariances = fusion.poses.covariances
    assert covariances is not None
    sigma = 1e3 * np.sqrt(np.median(covariances[:, 0, 0] + covariances[:, 1, 1]))
    used = ", ".join(f"{count} from {name}" for name, count in fusion.used.items())
    print(
        f"{options.output}: {len(fusion.poses)} poses out of {used}; "
        f"{len(fusion.rejected)} rejected, {counted(len(fusion.restarts_s), 'restart')}; "
        f"median sigma {sigma:.1f} mm"
    )
    _print_contradictions(options, fusion)
    if fusion.localisation is not None:
        print(
            f"{options.odometry} is treated as a localisation: its errors are stationary, of "
            f"{1e3 * fusion.localisation.position_sigma:.0f} mm in x and y and "
            f"{np.degrees(fusion.localisation.heading_sigma):.2f} degrees"
        )
    for segment in left_out:
        without = f"without {segment.from_s:.1f} s to {segment.to_s:.1f} s: "
        if segment.poses == 0:
            print(without + "no odometry")
            continue
        print(
            f"{without}predicted to {segment.position_rms_m:.3f} m, "
            f"{np.degrees(segment.heading_rms_rad):.2f} degrees "
            f"(rms; NEES {segment.normalised_error:.2f}); odometry aligned rigidly: "
            f"{segment.aligned_position_rms_m:.3f} m, "
            f"{np.degrees(segment.aligned_heading_rms_rad):.2f} degrees"
        )
    if fusion.pauses_s:
        warn(
            f"{options.odometry}: {counted(len(fusion.pauses_s), 'pause')}, "
            f"{_longest(fusion.pauses_s)}: the robot's path there is unknown, and covariances are "
            "increased"
        )


def _print_contradictions(options: Fuse, fusion: Fusion) -> None:
    """Say where odometry, measured poses and their covariances contradict each other."""
    for name, factor in fusion.jitter.items():
        if factor > 1.0:
            warn(
                f"the poses of {name} jitter {factor:.1f} times as much as their "
                "covariances allow: their deviations were raised by this factor"
            )
    for name, count in fusion.used.items():
        rejected = sum(one.stream == name for one in fusion.rejected)
        if rejected > _MANY_REJECTED * (count + rejected):
            warn(
                f"{rejected} of {count + rejected} poses of {name} contradict the others "
                f"and {options.odometry}: the clock, or the poses, may be wrong"
            )
    for scale, moved, advice in (
        (fusion.odometry.turn_scale, "turned", "are its angles radians, counter-clockwise?"),
        (fusion.odometry.distance_scale, "moved", "are its positions metres?"),
    ):
        if abs(scale) > _LARGEST_SCALE:
            warn(
                f"{options.odometry}: the robot {moved} {1.0 + scale:.2f} times as much as it "
                f"says: {advice}"
            )
    if fusion.resets_s:
        warn(
            f"{options.odometry}: {counted(len(fusion.resets_s), 'step')} that no robot can make, "
            f"the first at {fusion.resets_s[0][1]:.3f} s, left out (a driver that restarted?)"
        )
    if fusion.slips_s:
        warn(
            f"{options.odometry}: contradicts the measured poses "
            f"{counted(len(fusion.slips_s), 'time')}, as after a slip of the wheels, "
            f"{_longest(fusion.slips_s)}"
        )


def _longest(intervals: Sequence[tuple[float, float]]) -> str:
    """The longest of some intervals (s), in words."""
    begin, end = max(intervals, key=lambda interval: interval[1] - interval[0])
    return f"the longest from {begin:.3f} s to {end:.3f} s on the ground truth's clock"
