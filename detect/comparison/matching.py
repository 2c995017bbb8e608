"""Matches the discs, or lines, of images with reference rows: one to one, within a gate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from detect.comparison.result import FrameMatch, Kind
from detect.options import CompareOptions
from detect.projection import DiscProjection
from detect.sources.image_files import image_name
from redetect.array_types import FloatArray
from redetect.landmarks import (
    Association,
    CircleLandmark,
    Frame,
    LineLandmark,
    associate,
    associate_positions,
    circle_arrays,
    wrap_angle,
)

#: Of discs that are compared on the floor, where nothing else is said (m).
FLOOR_GATE_M = 0.10
# Breaks ties between pairs of lines, so that the result does not depend on the file's order.
_line_order = attrgetter("alpha", "sigma", "beta", "xtop", "ytop", "xbottom", "ybottom", "ids")


def match_runs(
    kind: Kind,
    reference: Mapping[str, Frame],
    detected: Mapping[str, Frame],
    options: CompareOptions,
    projection: DiscProjection | None = None,
    unlisted: Iterable[Frame] | None = None,
) -> tuple[FrameMatch, ...]:
    """Match the rows of two runs, image by image.

    Images are in the order of the reference; those in only one run are ignored.
    """
    known = {image_name(frame.step.prefix): frame for frame in unlisted or ()}
    matches = []
    for name in (name for name in reference if name in detected):
        frames = reference[name], detected[name]
        of_frame = None if projection is None else projection.for_frame(*frames)
        matches.append(match_frame(kind, name, *frames, options, of_frame, known.get(name)))
    return tuple(matches)


def match_frame(
    kind: Kind,
    name: str,
    reference: Frame | None,
    detected: Frame | None,
    options: CompareOptions,
    projection: DiscProjection | None = None,
    unlisted: Frame | None = None,
) -> FrameMatch:
    """Match the discs or the lines of one image one to one; a frame that is None has no rows.

    Detected rows that match an unlisted disc or line (or a reference row without ID, if these
    do not count), and no reference row that counts, are set aside.
    """
    pair_up: Callable[..., Association] = partial(pair_lines, options=options)
    if kind == "circles":
        pair_up = partial(pair_discs, options=options, projection=projection)
    frames = reference, detected, unlisted
    counted, found, uncounted = ([*getattr(frame, kind, ())] for frame in frames)
    if kind == "lines":
        for rows in (counted, found, uncounted):
            rows.sort(key=_line_order)
    if options.only_identified:
        uncounted += [row for row in counted if not row.identified]
        counted = [row for row in counted if row.identified]
    pairs = pair_up(counted, found)
    first, left = ([counted[i] for i in side] for side in (pairs.first, pairs.first_unmatched))
    second, alone = ([found[j] for j in side] for side in (pairs.second, pairs.second_unmatched))
    aside = pair_up(uncounted, alone)
    if kind == "lines":
        reach = numbers(second, "sigma") * options.sigmas
        joined = np.asarray((np.abs(_bearing_differences(left, second)) <= reach).any(axis=1))
        errors = np.degrees(np.abs(wrap_angle(numbers(second, "alpha") - numbers(first, "alpha"))))
    else:
        joined = np.zeros(len(left), dtype=np.bool_)
        first_xy = levelled_xy(first, projection)
        errors = np.linalg.norm(circle_arrays(second).xy - first_xy, axis=1)
    return FrameMatch(
        name,
        projection,
        found,
        matched_reference=first,
        matched=second,
        joined=[row for row, with_another in zip(left, joined) if with_another],
        missed=[row for row, with_another in zip(left, joined) if not with_another],
        extra=[alone[j] for j in aside.second_unmatched],
        set_aside=[alone[j] for j in np.sort(aside.second)],
        largest_error=float(errors.max()) if len(errors) else None,
    )


def pair_discs(
    reference: Sequence[CircleLandmark],
    detected: Sequence[CircleLandmark],
    options: CompareOptions,
    projection: DiscProjection | None = None,
) -> Association:
    """Pair discs of one frame one to one: as many as possible, with least squared distances.

    They are paired in the image if there is a projection, unless the options demand the floor.
    """
    first, second = circle_arrays(reference), circle_arrays(detected)
    if projection is not None and options.gate_m is None:
        first_px, second_px = projection.reference_px(first.xy), projection.detected_px(second.xy)
        gate = projection.gates(first.xy)
        offset = (second_px[None] - first_px[:, None]) / gate[:, None]
        cost = np.where(np.isfinite(offset).all(axis=-1), (offset**2).sum(axis=-1), np.inf)
        return associate(np.minimum(cost, 2.0), cost <= 1.0)
    gate_m = FLOOR_GATE_M if options.gate_m is None else options.gate_m
    return associate_positions(first.xy, second.xy, gate_m=gate_m)


def pair_lines(
    reference: Sequence[LineLandmark], detected: Sequence[LineLandmark], options: CompareOptions
) -> Association:
    """Pair lines of one frame one to one by bearing, with least squared differences.

    The gate is the larger of the tolerance and a multiple of the detected row's sigma.
    """
    difference = _bearing_differences(reference, detected)
    by_sigma = numbers(detected, "sigma") * options.sigmas
    gate = np.maximum(np.radians(options.tolerance_deg), by_sigma)
    return associate(difference**2, np.abs(difference) <= gate)


def error_px(match: FrameMatch) -> FloatArray:
    """(M,) distances of matched discs in the image; NaN if one is not visible."""
    projection = match.projection
    assert projection is not None
    first, second = (circle_arrays(rows).xy for rows in (match.matched_reference, match.matched))
    between = projection.detected_px(second) - projection.reference_px(first)
    return np.asarray(np.linalg.norm(between, axis=1))


def levelled_xy(rows: Sequence[CircleLandmark], projection: DiscProjection | None) -> FloatArray:
    """(M, 2) floor positions of reference discs, levelled as the detected ones are."""
    xy = circle_arrays(rows).xy
    return xy if projection is None else projection.levelled_as_detected(xy)


def numbers(rows: Sequence[Any], name: str) -> FloatArray:
    """(N,) one number of each row."""
    return np.array([getattr(row, name) for row in rows], dtype=np.float64)


def _bearing_differences(
    reference: Sequence[LineLandmark], detected: Sequence[LineLandmark]
) -> FloatArray:
    """(N, M) bearings of detected lines minus those of reference lines (rad)."""
    return wrap_angle(numbers(detected, "alpha") - numbers(reference, "alpha")[:, np.newaxis])
