"""Compares detected discs, or lines, with reference rows of the same run.

Whether the same disc is seen is one question; where on the floor each side puts it is a second one:
its differences, and the tilt and height of the camera that would explain them.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from math import inf, isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.comparison.figures import normalised_error, quantile
from detect.comparison.floor import floor_bins, floor_pairs
from detect.comparison.matching import (
    FLOOR_GATE_M,
    apart_px,
    frames_by_image,
    match_runs,
    numbers,
    pair_discs,
)
from detect.comparison.result import (
    CompareOptions,
    DiscComparison,
    DistanceBin,
    FrameMatch,
    Levelling,
    LineComparison,
    LinePairs,
)
from detect.seen import Sight
from detect.sources.image_names import image_name
from redetect.landmarks import CircleArrays, Frame, circle_arrays, read_frames, wrap_angle

FloatArray = NDArray[np.float64]

# The forward distances for which the data set's own qualities are known.
_EDGES_M = (-inf, 0.8, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, inf)
# Files hold six digits: a smaller sigma is no statement about a bearing.
LEAST_SIGMA_RAD = 1e-12


class Beside(NamedTuple):
    """What else than the reference rows is in view.

    Detected rows on `unlisted` discs are neither right nor wrong, those on `lookalikes` are extra
    and counted apart.
    """

    unlisted: tuple[Frame, ...] = ()
    lookalikes: tuple[Frame, ...] | None = None


def beside_reference(
    reference: str | os.PathLike[str],
    unlisted: Path | None = None,
    lookalikes: Path | None = None,
) -> Beside:
    """Read ``unlisted.circles`` and ``lookalikes.circles`` beside a reference file, or others."""
    usual = Path(reference).parent / "unlisted.circles"
    known = tuple(read_frames(unlisted or usual)) if unlisted or usual.is_file() else ()
    usual = Path(reference).parent / "lookalikes.circles"
    alike = tuple(read_frames(lookalikes or usual)) if lookalikes or usual.is_file() else None
    return Beside(known, alike)


def compare_runs(
    run: str | os.PathLike[str],
    *,
    reference: str | os.PathLike[str] | None = None,
    detected: str | os.PathLike[str] | None = None,
    options: CompareOptions | None = None,
    sight: Sight | None = None,
    beside: Beside | None = None,
) -> DiscComparison:
    """Compare a run's detected discs with its reference rows.

    Parameters
    ----------
    run : path
        The run's folder.
    reference, detected : path, optional
        By default ``map.circles`` and ``detected.circles`` in that folder.
    options : CompareOptions, optional
    sight : Sight, optional
        How rows come back into the images; without it, they are compared on the floor.
    beside : Beside, optional
        What else is in view; by default as the reference's folder has it.

    Raises
    ------
    redetect.landmarks.LandmarkFileError
        If a file cannot be read.
    CompareError
        If an image has two frames in a file, or a covariance that is needed is not positive
        definite.
    """
    reference = Path(run) / "map.circles" if reference is None else reference
    detected = Path(run) / "detected.circles" if detected is None else detected
    return compare_frames(
        read_frames(reference),
        read_frames(detected),
        options,
        sight=sight,
        beside=beside_reference(reference) if beside is None else beside,
        names=(os.fspath(reference), os.fspath(detected)),
    )


def compare_frames(
    reference: Iterable[Frame],
    detected: Iterable[Frame],
    options: CompareOptions | None = None,
    *,
    sight: Sight | None = None,
    beside: Beside | None = None,
    names: tuple[str, str] = ("reference", "detected"),
) -> DiscComparison:
    """Compare the discs of two sets of frames, called `names` in messages, as `compare_runs`."""
    options, beside = options or CompareOptions(), beside or Beside()
    in_image = sight is not None and not options.on_floor
    if not in_image and options.gate_m is None:
        options = replace(options, gate_m=FLOOR_GATE_M)
    wanted, found = frames_by_image(reference, names[0]), frames_by_image(detected, names[1])
    unlisted = {image_name(frame.step.prefix): frame for frame in beside.unlisted}
    common = match_runs("circles", wanted, found, options, names, sight, unlisted)
    matches = common.frames
    first, second, missed, extra = sides = (
        circle_arrays([row for m in matches for row in m.paired[0]]),
        circle_arrays([row for m in matches for row in m.paired[1]]),
        circle_arrays([row for m in matches for row in m.missed]),
        circle_arrays([row for m in matches for row in m.extra]),
    )
    covariance = {
        "detected": second.covariance,
        "reference": first.covariance,
        "sum": first.covariance + second.covariance,
    }[options.error_covariance]
    lean, pairs = floor_pairs(
        None if sight is None else sight.camera,
        first.xy,
        second.xy,
        covariance,
        np.repeat(np.arange(len(matches)), [len(match.matched) for match in matches]),
    )
    apart = [] if sight is None else [apart_px(match) for match in matches]
    image_px = np.concatenate([np.zeros(0), *apart])
    image_px = image_px[np.isfinite(image_px)]
    error_m = np.concatenate([np.zeros(0), *(match.errors for match in matches)])
    true = sight is not None and sight.reference_level
    ranges = list(pairwise(_EDGES_M))
    return DiscComparison(
        **vars(common),
        on_lookalikes=_on_lookalikes(matches, beside, options),
        error_median_m=quantile(error_m),
        error_95_m=quantile(error_m, 0.95),
        normalised_error=normalised_error(pairs.offset, covariance),
        reference_quality_matched=quantile(first.quality),
        reference_quality_missed=quantile(missed.quality),
        detected_quality_matched=quantile(second.quality),
        detected_quality_extra=quantile(extra.quality),
        bins=tuple(_distance_bin(ends, sides, error_m) for ends in ranges),
        in_image=in_image,
        image_median_px=quantile(image_px),
        image_95_px=quantile(image_px, 0.95),
        reference_levelling=_levelling(matches, wanted, true=true),
        detected_levelling=_levelling(matches, found),
        floor=floor_bins(pairs, lean, ranges),
        lean=lean,
        pairs=pairs,
    )


def compare_line_frames(
    reference: Iterable[Frame],
    detected: Iterable[Frame],
    options: CompareOptions | None = None,
    *,
    names: tuple[str, str] = ("reference", "detected"),
) -> LineComparison:
    """Compare the lines of two sets of frames, called `names` in messages.

    Errors as of `compare_runs`.
    """
    options = options or CompareOptions()
    sides = frames_by_image(reference, names[0]), frames_by_image(detected, names[1])
    common = match_runs("lines", *sides, options, names)
    first, second = ([row for m in common.frames for row in m.paired[side]] for side in (0, 1))

    def difference(name: str) -> FloatArray:
        return numbers(second, name) - numbers(first, name)

    bearing_rad, sigma_rad = numbers(first, "alpha"), numbers(second, "sigma")
    error_rad = wrap_angle(difference("alpha"))
    error_deg = np.degrees(np.abs(error_rad))
    variance = np.where(sigma_rad >= LEAST_SIGMA_RAD, sigma_rad**2, 0.0)
    ends = [
        np.hypot(difference(x), difference(y))
        for x, y in (("xtop", "ytop"), ("xbottom", "ybottom"))
    ]
    return LineComparison(
        **vars(common),
        bearing_median_deg=quantile(error_deg),
        bearing_95_deg=quantile(error_deg, 0.95),
        normalised_error=normalised_error(error_rad[:, None], variance[:, None, None]),
        ends_median=quantile(np.concatenate(ends)),
        beta_median_deg=quantile(np.degrees(np.abs(difference("beta")))),
        pairs=LinePairs(bearing_rad, error_rad, sigma_rad),
    )


def _distance_bin(
    range_m: tuple[float, float], sides: tuple[CircleArrays, ...], error_m: FloatArray
) -> DistanceBin:
    """The bin of a range; `sides` are matched reference and detected rows, missed and extra."""
    from_m, to_m = range_m
    inside = [(from_m <= -side.xy[:, 1]) & (-side.xy[:, 1] < to_m) for side in sides]
    first, second, missed, extra = (int(mask.sum()) for mask in inside)
    qualities = [side.quality[mask] for side, mask in zip(sides, inside)]
    wanted = quantile(np.concatenate([qualities[0], qualities[2]]))
    found = quantile(np.concatenate([qualities[1], qualities[3]]))
    return DistanceBin(
        from_m=from_m if isfinite(from_m) else None,
        to_m=to_m if isfinite(to_m) else None,
        reference=first + missed,
        missed=missed,
        detected=second + extra,
        extra=extra,
        recall=first / (first + missed) if first + missed else None,
        precision=second / (second + extra) if second + extra else None,
        reference_quality_median=wanted,
        detected_quality_median=found,
        error_median_m=quantile(error_m[inside[0]]),
        quality_difference=None if wanted is None or found is None else found - wanted,
    )


def _on_lookalikes(
    matches: Sequence[FrameMatch], beside: Beside, options: CompareOptions
) -> int | None:
    """How many extra rows are on look-alikes; None where these are not known."""
    if beside.lookalikes is None:
        return None
    known = {image_name(frame.step.prefix): frame.circles for frame in beside.lookalikes}
    return sum(
        len(pair_discs(known[m.frame.name], m.extra, options, m.frame.view).first)
        for m in matches
        if m.frame.name in known
    )


def _levelling(
    matches: Sequence[FrameMatch], frames: Mapping[str, Frame], *, true: bool = False
) -> Levelling:
    by = [frames[m.frame.name].levelled_by for m in matches if m.frame.name in frames]
    tilts = np.degrees([tilt for tilt in by if tilt is not None]).reshape(-1, 2)
    medians = (quantile(tilts[:, 0]), quantile(tilts[:, 1]))
    return Levelling(len(matches), len(tilts), true and not len(tilts), *medians)
