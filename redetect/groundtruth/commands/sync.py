"""``groundtruth sync``: files and printed results of the synchronisation of clocks."""

from __future__ import annotations

import math
from typing import Any

from redetect.groundtruth.commands.outputs import check_outputs, provenance
from redetect.groundtruth.files import write_json
from redetect.groundtruth.fusion.clock import ClockModel, ClockSegment, compare_with_ptpd, read_ptpd
from redetect.groundtruth.fusion.sync import synchronise
from redetect.groundtruth.options import Sync
from redetect.groundtruth.trajectories.streams import read_planar_poses

_CONFIDENCE = 1.959964


def perform(options: Sync) -> int:
    """Carry out ``groundtruth sync``; returns the exit code: 1 if no segment could be aligned."""
    check_outputs([options.output], options.force)
    odometry = read_planar_poses(options.odometry)
    truth = read_planar_poses(options.groundtruth)
    log = None if options.ptpd is None else read_ptpd(options.ptpd)
    segments = synchronise(odometry, truth, options.settings)
    for segment in segments:
        print(_line(segment))
    if not any(segment.is_determined for segment in segments):
        print("no segment could be synchronised: no clock file is written")
        return 1
    model = ClockModel(segments)
    document: dict[str, Any] = {
        **provenance(options.settings, [options.odometry, options.groundtruth]),
        "segments": segments,
    }
    if log is not None:
        document["ptpd"] = compare_with_ptpd(model, log)
        rms, inside = (document["ptpd"][k] for k in ("rms_difference_s", "reports_in_segments"))
        print(
            f"ptpd: {len(log.offset_s)} reports, {inside} compared, "
            + ("none in a segment" if rms is None else f"rms difference {1e3 * rms:.2f} ms")
        )
    write_json(options.output, document, overwrite=options.force)
    return 0


def _line(segment: ClockSegment) -> str:
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
