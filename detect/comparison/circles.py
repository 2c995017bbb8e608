"""Compares detected discs with reference rows of the same run.

Frames are matched by the names of their images; in each, detected rows are paired with reference
rows one to one within a gate: in the image, each where it was seen, or on the floor. What is left
over on either side is missed or extra. Where on the floor each puts a disc is a second question:
its differences, and the tilt and height of the camera that would explain them.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from math import inf, isfinite
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.comparison.figures import disc_normalised_error, fraction, quantile
from detect.comparison.floor import floor_bins, floor_pairs, stated_lean
from detect.comparison.pairing import FrameMatch, match_rows, pair_frames, shown_name
from detect.comparison.result import (
    CompareError,
    CompareOptions,
    Comparison,
    DistanceBin,
    FrameScore,
    Levelling,
)
from detect.seen import FrameView, Tilt, image_positions
from detect.sources.image_names import image_name
from landmarks import (
    Association,
    CircleLandmark,
    Frame,
    associate,
    associate_positions,
    associate_within_covariance,
    circle_arrays,
    is_positive_definite,
    read_frames,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# The forward distances for which the data set's own qualities are known.
DISTANCE_EDGES_M = (0.8, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
#: Of rows that are compared on the floor, where nothing else is said (m).
FLOOR_GATE_M = 0.10
RADIUS_M = 0.10


@dataclass(frozen=True, slots=True)
class Sight:
    """How rows come back into the images.

    Attributes
    ----------
    camera : Camera
    radius_m : float
        Of the discs.
    reference_level : bool
        Reference rows are level though they do not say by which tilt: they are seen through that
        of the detected rows.
    """

    camera: Camera
    radius_m: float = RADIUS_M
    reference_level: bool = False

    def of(self, reference_by: Tilt | None, detected_by: Tilt | None) -> FrameView:
        """The view of a frame whose rows these tilts levelled."""
        if self.reference_level and reference_by is None:
            reference_by = detected_by
        return FrameView(self.camera, self.radius_m, reference_by, detected_by)


@dataclass(frozen=True, slots=True)
class Beside:
    """What is in view besides the reference rows, where that is known.

    Attributes
    ----------
    unlisted : tuple of Frame
        Discs that may be detected but need not be: detected rows on them count neither as right
        nor as wrong.
    lookalikes : tuple of Frame or None
        What looks like a disc: detected rows on them are extra, and counted apart.
    """

    unlisted: tuple[Frame, ...] = ()
    lookalikes: tuple[Frame, ...] | None = None


def beside_reference(
    reference: str | os.PathLike[str],
    unlisted: Path | None = None,
    lookalikes: Path | None = None,
) -> Beside:
    """Read what is in view besides the rows of a reference file.

    By default ``unlisted.circles`` and ``lookalikes.circles`` in its folder, where they are there.
    """
    folder = Path(reference).parent
    unlisted = _if_there(folder / "unlisted.circles") if unlisted is None else unlisted
    lookalikes = _if_there(folder / "lookalikes.circles") if lookalikes is None else lookalikes
    return Beside(
        () if unlisted is None else tuple(read_frames(unlisted)),
        None if lookalikes is None else tuple(read_frames(lookalikes)),
    )


def _if_there(path: Path) -> Path | None:
    return path if path.is_file() else None


def compare_runs(
    run: str | os.PathLike[str],
    *,
    reference: str | os.PathLike[str] | None = None,
    detected: str | os.PathLike[str] | None = None,
    options: CompareOptions | None = None,
    sight: Sight | None = None,
    beside: Beside | None = None,
) -> Comparison:
    """Compare a run's detected discs with its reference rows.

    Parameters
    ----------
    run : path
        The run's folder.
    reference, detected : path, optional
        By default ``map.circles`` and ``detected.circles`` in that folder.
    options : CompareOptions, optional
        What counts as the same disc, and which rows count.
    sight : Sight, optional
        How rows come back into the images; without it, they are compared on the floor.
    beside : Beside, optional
        What is in view besides the reference rows; by default as the reference's folder has it.

    Returns
    -------
    Comparison
        The figures.

    Raises
    ------
    landmarks.LandmarkFileError
        If a file cannot be read.
    CompareError
        If a frame occurs twice in a file, or the gate needs a reference row's covariance and that
        is not positive definite.
    """
    reference = Path(run) / "map.circles" if reference is None else reference
    detected = Path(run) / "detected.circles" if detected is None else detected
    return compare_frames(
        read_frames(reference),
        read_frames(detected),
        options or CompareOptions(),
        sight=sight,
        beside=beside_reference(reference) if beside is None else beside,
        reference_name=os.fspath(reference),
        detected_name=os.fspath(detected),
    )


def compare_frames(
    reference: Iterable[Frame],
    detected: Iterable[Frame],
    options: CompareOptions,
    *,
    sight: Sight | None = None,
    beside: Beside | None = None,
    reference_name: str = "reference",
    detected_name: str = "detected",
) -> Comparison:
    """Compare the discs of two sets of frames; errors and reports use their names.

    See `compare_runs`.
    """
    reference, detected = list(reference), list(detected)
    paired = pair_frames(
        reference,
        detected,
        lambda frame: frame.circles,
        all_frames=options.all_frames,
        reference_name=reference_name,
        detected_name=detected_name,
    )
    in_image = sight is not None and not options.on_floor
    if not in_image and options.gate_m is None:
        options = replace(options, gate_m=FLOOR_GATE_M)
    wanted_by, found_by = _levelled_by(reference), _levelled_by(detected)
    views = [
        None if sight is None else sight.of(wanted_by.get(name), found_by.get(name))
        for name, *_ in paired.frames
    ]
    beside = beside or Beside()
    unlisted = _rows_by_name(beside.unlisted)
    matches = [
        _match_frame(frame, options, view if in_image else None, unlisted.get(frame[0], ()))
        for frame, view in zip(paired.frames, views)
    ]
    wanted = _pool([(match.reference, match.pairs.first) for match in matches])
    found = _pool([(match.detected, match.pairs.second) for match in matches])
    apart_px = _apart_px(matches, views)
    sides = {"detected": (found,), "reference": (wanted,), "sum": (wanted, found)}
    errors_of = sides[options.error_covariance]
    covariance = np.sum([side.covariance[side.paired] for side in errors_of], axis=0)
    lean, pairs = floor_pairs(
        None if sight is None else sight.camera,
        wanted.xy[wanted.paired],
        found.xy[found.paired],
        covariance,
        np.repeat(np.arange(len(matches)), [len(match.pairs.first) for match in matches]),
    )
    error_m = np.asarray(np.linalg.norm(pairs.offset, axis=1), dtype=np.float64)
    names = [name for name, *_ in paired.frames]
    return Comparison(
        reference_name=reference_name,
        detected_name=detected_name,
        options=options,
        reference=len(wanted.xy),
        detected=len(found.xy),
        matched=len(error_m),
        set_aside=sum(match.set_aside for match in matches),
        on_lookalikes=_on_lookalikes(matches, beside, options, views if in_image else None),
        recall=_mean(wanted.is_paired),
        precision=_mean(found.is_paired),
        error_median_m=quantile(error_m, 0.5),
        error_95_m=quantile(error_m, 0.95),
        normalised_error=disc_normalised_error(pairs.offset, covariance),
        reference_quality_matched=quantile(wanted.quality[wanted.is_paired], 0.5),
        reference_quality_missed=quantile(wanted.quality[~wanted.is_paired], 0.5),
        detected_quality_matched=quantile(found.quality[found.is_paired], 0.5),
        detected_quality_extra=quantile(found.quality[~found.is_paired], 0.5),
        bins=tuple(_distance_bin(*ends, wanted, found, error_m) for ends in _ranges()),
        in_image=in_image,
        image_median_px=quantile(apart_px, 0.5),
        image_95_px=quantile(apart_px, 0.95),
        reference_levelling=_levelling(
            names, wanted_by, true=sight is not None and sight.reference_level
        ),
        detected_levelling=_levelling(names, found_by),
        floor=floor_bins(pairs, lean, _ranges()),
        lean=stated_lean(lean, pairs),
        pairs=pairs,
        frames=_frame_scores(matches, error_m),
        frames_only_in_reference=paired.only_in_reference,
        frames_only_in_detected=paired.only_in_detected,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Pool:
    """All rows of one side that count; `paired` are those in pairs, in the order of the pairs."""

    xy: FloatArray
    quality: FloatArray
    covariance: FloatArray
    paired: NDArray[np.intp]
    is_paired: BoolArray


def _rows_by_name(frames: Iterable[Frame]) -> dict[str, tuple[CircleLandmark, ...]]:
    return {image_name(frame.step.prefix): frame.circles for frame in frames}


def _on_lookalikes(
    matches: Sequence[FrameMatch[CircleLandmark]],
    beside: Beside,
    options: CompareOptions,
    views: Sequence[FrameView | None] | None,
) -> int | None:
    """How many extra rows are on look-alikes; None where these are not known."""
    if beside.lookalikes is None:
        return None
    known = _rows_by_name(beside.lookalikes)
    count = 0
    for k, match in enumerate(matches):
        rows = known.get(match.name, ())
        extra = [match.detected[i] for i in match.pairs.second_alone]
        if rows and extra:
            view = None if views is None else views[k]
            count += len(pair_discs(rows, extra, options, view).first)
    return count


def _match_frame(
    frame: tuple[str, Sequence[CircleLandmark], Sequence[CircleLandmark]],
    options: CompareOptions,
    view: FrameView | None,
    optional: Sequence[CircleLandmark],
) -> FrameMatch[CircleLandmark]:
    name, reference, detected = frame
    measurable = is_positive_definite(circle_arrays(reference).covariance)
    if options.sigma is not None and not measurable.all():
        raise CompareError(
            f"frame {shown_name(name)}: a reference row's covariance is not positive definite: "
            "expected one to measure sigmas in; a gate in metres needs none"
        )
    return match_rows(
        name,
        reference,
        detected,
        lambda some, others: pair_discs(some, others, options, view),
        only_identified=options.only_identified,
        optional=optional,
    )


def pair_discs(
    reference: Sequence[CircleLandmark],
    detected: Sequence[CircleLandmark],
    options: CompareOptions,
    view: FrameView | None = None,
) -> Association:
    """Pair discs one to one.

    Parameters
    ----------
    reference, detected : sequence of CircleLandmark
        Rows of one frame.
    options : CompareOptions
        The gate.
    view : FrameView, optional
        How the rows come back into the image: compares there, unless the options ask for the floor.

    Returns
    -------
    Association
        As many pairs of reference (first) and detected rows (second) as possible, and of those with
        the least sum of squared distances (in the image: in units of the gate).
    """
    first, second = circle_arrays(reference), circle_arrays(detected)
    if view is not None and not options.on_floor:
        seen = image_positions(view.camera, first.xy, view.reference_by)
        again = image_positions(view.camera, second.xy, view.detected_by)
        gate = view.gates(first.xy, options.least_px)
        apart = (again[None] - seen[:, None]) / gate[:, None]
        cost = np.where(np.isfinite(apart).all(axis=-1), (apart**2).sum(axis=-1), np.inf)
        return associate(np.minimum(cost, 2.0), cost <= 1.0)
    if options.sigma is None:
        gate_m = FLOOR_GATE_M if options.gate_m is None else options.gate_m
        return associate_positions(first.xy, second.xy, gate_m=gate_m)
    return associate_within_covariance(
        first.xy, second.xy, first.covariance, gate_sigma=options.sigma
    )


def _pool(frames: Sequence[tuple[Sequence[CircleLandmark], NDArray[np.intp]]]) -> _Pool:
    arrays = circle_arrays([row for rows, _ in frames for row in rows])
    starts = accumulate((len(rows) for rows, _ in frames), initial=0)
    paired = np.array(
        [start + i for start, (_, indices) in zip(starts, frames) for i in indices], dtype=np.intp
    )
    is_paired = np.zeros(len(arrays.xy), dtype=np.bool_)
    is_paired[paired] = True
    return _Pool(arrays.xy, arrays.quality, arrays.covariance, paired, is_paired)


def _ranges() -> list[tuple[float, float]]:
    return list(pairwise((-inf, *DISTANCE_EDGES_M, inf)))


def _levelled_by(frames: Sequence[Frame]) -> dict[str, Tilt]:
    return {
        image_name(frame.step.prefix): frame.levelled_by
        for frame in frames
        if frame.levelled_by is not None
    }


def _levelling(names: Sequence[str], by: Mapping[str, Tilt], *, true: bool = False) -> Levelling:
    tilts = np.degrees([by[name] for name in names if name in by]).reshape(-1, 2)
    return Levelling(
        len(names),
        len(tilts),
        true and not len(tilts),
        quantile(tilts[:, 0], 0.5),
        quantile(tilts[:, 1], 0.5),
    )


def _apart_px(
    matches: Sequence[FrameMatch[CircleLandmark]], views: Sequence[FrameView | None]
) -> FloatArray:
    """Distances of matched rows in the image."""
    apart = [np.zeros(0)]
    for match, view in zip(matches, views):
        if view is None or not len(match.pairs.first):
            continue
        first = circle_arrays([match.reference[i] for i in match.pairs.first]).xy
        second = circle_arrays([match.detected[j] for j in match.pairs.second]).xy
        offset = image_positions(view.camera, second, view.detected_by) - image_positions(
            view.camera, first, view.reference_by
        )
        apart.append(np.linalg.norm(offset, axis=1))
    together = np.concatenate(apart)
    return together[np.isfinite(together)]


def _distance_bin(
    from_m: float, to_m: float, wanted: _Pool, found: _Pool, error_m: FloatArray
) -> DistanceBin:
    wanted_here, found_here = (
        (from_m <= -pool.xy[:, 1]) & (-pool.xy[:, 1] < to_m) for pool in (wanted, found)
    )
    return DistanceBin(
        from_m=from_m if isfinite(from_m) else None,
        to_m=to_m if isfinite(to_m) else None,
        reference=int(wanted_here.sum()),
        missed=int((wanted_here & ~wanted.is_paired).sum()),
        detected=int(found_here.sum()),
        extra=int((found_here & ~found.is_paired).sum()),
        recall=_mean(wanted.is_paired[wanted_here]),
        precision=_mean(found.is_paired[found_here]),
        reference_quality_median=quantile(wanted.quality[wanted_here], 0.5),
        detected_quality_median=quantile(found.quality[found_here], 0.5),
        error_median_m=quantile(error_m[wanted_here[wanted.paired]], 0.5),
    )


def _frame_scores(
    matches: Sequence[FrameMatch[CircleLandmark]], error_m: FloatArray
) -> tuple[FrameScore, ...]:
    ends = list(accumulate(len(match.pairs.first) for match in matches))
    return tuple(
        FrameScore(
            name=match.name,
            matched=len(match.pairs.first),
            missed=len(match.pairs.first_alone),
            extra=len(match.pairs.second_alone),
            largest_error_m=quantile(error_m[end - len(match.pairs.first) : end], 1.0),
        )
        for match, end in zip(matches, ends)
    )


def _mean(mask: BoolArray) -> float | None:
    return fraction(int(mask.sum()), len(mask))
