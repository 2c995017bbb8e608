"""Fits one straight line to all segments of a session, if the robot's clock ran evenly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from redetect.groundtruth.clocks.clock import ClockSegment

_AGREEMENT = 0.999


def on_one_line(segments: Sequence[ClockSegment]) -> list[ClockSegment]:
    """Put segments on the straight line through all of them, if that agrees with each.

    A clock that is neither disciplined nor set runs evenly over minutes. Segments that are minutes
    apart then determine its rate much better than each alone, and its offset somewhat better.

    Parameters
    ----------
    segments : sequence of ClockSegment
        Of one session, in order.

    Returns
    -------
    list of ClockSegment
        With the line's offsets, rates and deviations, and a note; unchanged where fewer than two
        segments are determined, a clock was set, or one line does not explain them: its squared
        error is larger than one session in a thousand has by chance.
    """
    determined = [segment for segment in segments if segment.status == "ok"]
    others = {segment.status for segment in segments} - {"ok", "no turns"}
    if len(determined) < 2 or others:
        return list(segments)
    middle = float(np.mean([segment.reference_s for segment in determined]))
    rows, values, sigmas = [], [], []
    for segment in determined:
        rows += [(1.0, segment.reference_s - middle), (0.0, 1.0)]
        values += [segment.offset_s, segment.rate - 1.0]
        sigmas += [segment.sigma_offset_s, segment.sigma_rate]
    weight = 1.0 / np.array(sigmas)
    design = np.array(rows) * weight[:, None]
    target = np.array(values) * weight
    covariance = np.linalg.inv(design.T @ design)
    line = covariance @ design.T @ target
    squared = float(np.sum((target - design @ line) ** 2))
    freedom = len(values) - 2
    if squared > chdtri(freedom, 1.0 - _AGREEMENT):
        return list(segments)
    note = f"one line through {len(determined)} segments: chi2 {squared:.1f} of {freedom}"
    result = []
    for segment in segments:
        at = np.array([1.0, segment.reference_s - middle])
        if segment.status == "ok":
            segment = replace(
                segment,
                offset_s=float(at @ line),
                rate=1.0 + float(line[1]),
                sigma_offset_s=math.sqrt(at @ covariance @ at),
                sigma_rate=math.sqrt(covariance[1, 1]),
                note=note,
            )
        result.append(segment)
    return result
