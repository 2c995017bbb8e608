"""Compares detected discs, or lines, with reference rows of the same run.

Discs are paired in the image, or on the floor; lines by bearing. Differences of paired discs on the
floor are computed for the rows as written, and after levelling both by the tilt of the detected
ones. A detected line can represent several: unpaired reference lines within its sigma are found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from camera import Camera, camera_in, read_camera
from detect.comparison.result import (
    Comparison,
    DiscComparison,
    DiscPairs,
    DistanceBin,
    FrameMatch,
    Kind,
    LineComparison,
    LinePairs,
    floor_difference,
    normalised_error,
    quantile,
)
from detect.errors import CompareError, DetectError
from detect.options import CompareOptions
from detect.projection import LEAST_GATE_PX, DiscProjection
from detect.row_files import circle_settings_of
from detect.sources.image_files import image_name
from redetect.array_types import FloatArray
from redetect.landmarks import (
    Association,
    CircleArrays,
    CircleLandmark,
    Frame,
    LineLandmark,
    associate,
    associate_positions,
    circle_arrays,
    read_frames,
    wrap_angle,
)
from redetect.landmarks.files import read_head
from redetect.messages import excerpt

# Edges of the ranges of forward distances (m).
_EDGES_M = (-np.inf, 0.8, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, np.inf)
LEAST_SIGMA_RAD = 1e-12  # Files have six digits: a smaller sigma is meaningless.

#: Deviation from whole pixels that rounding positions to six digits causes.
_WHOLE_PX = 0.01
#: Of discs that are compared on the floor, where nothing else is said (m).
FLOOR_GATE_M = 0.10
# Breaks ties between pairs of lines, so that the result does not depend on the file's order.
_line_order = attrgetter("alpha", "sigma", "beta", "xtop", "ytop", "xbottom", "ybottom", "ids")


def compare_run(
    run: Path,
    kind: Kind = "circles",
    detected: Path | None = None,
    reference: Path | None = None,
    *,
    camera: Camera | Path | None = None,
    options: CompareOptions | None = None,
    unlisted: Path | None = None,
) -> Comparison:
    """Compare the detected discs, or lines, of a run with reference rows, both from files.

    By default these are `detected.circles` and `map.circles` (or `.lines`) in the run folder, with
    its calibration; without any, discs are compared on the floor. Other parameters and errors as of
    `compare_with_file`, and DetectError if there is no such file.
    """
    reference, detected = reference or run / f"map.{kind}", detected or run / f"detected.{kind}"
    for path, advice in (
        (reference, "give the reference rows with --reference"),
        (detected, f"`detect {kind}` writes it, or give another with --detected"),
    ):
        if not path.exists():
            raise DetectError(f"{path}: no such landmark file: {advice}")
    projection = None
    if kind == "circles":
        camera = camera_in(run) if camera is None else camera
        camera = read_camera(camera) if isinstance(camera, Path) else camera
        settings, level = circle_settings_of(read_head(detected)), read_head(reference).level
        projection = None if camera is None else DiscProjection(camera, settings, level)
    rows, names = read_kind(kind, detected), (str(reference), str(detected))
    return compare_with_file(
        kind, reference, rows, options, projection=projection, unlisted=unlisted, names=names
    )


def compare_with_file(
    kind: Kind,
    reference: Path,
    detected: Iterable[Frame],
    options: CompareOptions | None = None,
    *,
    projection: DiscProjection | None = None,
    unlisted: Path | None = None,
    names: tuple[str, str],
) -> Comparison:
    """Compare discs, or lines, with those of a reference file.

    Other parameters as in `compare_frames`; look-alikes, and by default unlisted rows, are those in
    the reference's folder. Raises `redetect.landmarks.LandmarkFileError` if a file cannot be read,
    and CompareError if all rows of the reference are of the other kind, or no image is in both.
    """
    wanted, detected = read_kind(kind, reference), list(detected)
    images = map(frames_by_image, (wanted, detected), names)
    if not set.intersection(*map(set, images)):
        raise CompareError(f"no image is in both {names[0]} and {names[1]}: expected one run")
    beside = rows_beside(reference, "unlisted", kind)
    uncounted = beside if unlisted is None else list(read_frames(unlisted))
    if kind == "lines":
        return compare_line_frames(wanted, detected, options, unlisted=uncounted, names=names)
    return compare_frames(
        wanted,
        detected,
        options,
        projection=projection,
        unlisted=uncounted,
        lookalikes=rows_beside(reference, "lookalikes"),
        names=names,
    )


def rows_beside(reference: Path, name: str, kind: Kind = "circles") -> list[Frame] | None:
    """The rows of a file of some name beside the reference; None without such a file."""
    path = reference.parent / f"{name}.{kind}"
    return list(read_frames(path)) if path.is_file() else None


def read_kind(kind: Kind, path: Path) -> list[Frame]:
    """The frames of a file; a CompareError if all its rows are of the other kind."""
    frames = list(read_frames(path))
    other = "circles" if kind == "lines" else "lines"
    has, has_other = (any(getattr(frame, rows) for frame in frames) for rows in (kind, other))
    if has_other and not has:
        raise CompareError(f"{path}: its rows are {other}: expected {kind}")
    return frames


def compare_frames(
    reference: Iterable[Frame],
    detected: Iterable[Frame],
    options: CompareOptions | None = None,
    *,
    projection: DiscProjection | None = None,
    unlisted: Iterable[Frame] | None = None,
    lookalikes: Iterable[Frame] | None = None,
    names: tuple[str, str] = ("reference", "detected"),
) -> DiscComparison:
    """Compare the discs of two sets of frames.

    Parameters
    ----------
    reference, detected : iterable of Frame
    options : CompareOptions, optional
    projection : DiscProjection, optional
        Projects rows into the images; without it, they are compared on the floor.
    unlisted : iterable of Frame, optional
        Discs that may be detected but need not be: rows matching them are neither right nor wrong.
    lookalikes : iterable of Frame, optional
        Known look-alikes of discs: rows that match them are extra, and counted separately.
    names : (str, str)
        Names of the two sets in messages.

    Raises
    ------
    CompareError
        If an image has two frames.
    """
    options = options or CompareOptions()
    unlisted = list(unlisted or ())
    in_image = projection is not None and options.gate_m is None
    if not in_image and options.gate_m is None:
        options = replace(options, gate_m=FLOOR_GATE_M)
    wanted, found = frames_by_image(reference, names[0]), frames_by_image(detected, names[1])
    match = partial(match_runs, "circles", wanted, found, options, unlisted=unlisted)
    matches = match(projection)
    if projection is not None and not projection.reference_level:
        # A file need not state that its rows are level: then the matches in the images decide.
        with_level = replace(projection, reference_level=True)
        as_level = match(with_level)
        if _image_cost(as_level) < _image_cost(matches):
            matches, projection = as_level, with_level
    first, second, _, extra = sides = tuple(
        circle_arrays([row for match in matches for row in getattr(match, side)])
        for side in ("wanted", "matched", "missed", "extra")
    )
    levelled = [_levelled_xy(match.wanted, match.projection) for match in matches]
    alike_xy = np.concatenate([np.zeros((0, 2)), *levelled])
    away = first.xy - (np.zeros(2) if projection is None else projection.camera.centre[:2])
    away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    pairs = DiscPairs(first.xy, second.xy - first.xy, second.xy - alike_xy, second.covariance, away)
    errors_px = [] if projection is None else [error_px(match) for match in matches]
    image_px = np.concatenate([np.zeros(0), *errors_px])
    image_px = image_px[np.isfinite(image_px)]
    error_m = np.linalg.norm(pairs.offset, axis=1)
    farthest_m = np.linalg.norm(second.xy, axis=1).max(initial=0.0)
    return DiscComparison(
        **_rates(matches, wanted, found, options, names),
        on_lookalikes=_on_lookalikes(matches, lookalikes, options),
        normalised_error=normalised_error(pairs.offset, second.covariance),
        error_median_m=quantile(error_m),
        error_95_m=quantile(error_m, 0.95),
        bins=tuple(_distance_bin(low, high, sides, pairs) for low, high in pairwise(_EDGES_M)),
        extra_beyond=int((np.linalg.norm(extra.xy, axis=1) > farthest_m).sum()),
        in_image=in_image,
        image_median_px=quantile(image_px),
        image_95_px=quantile(image_px, 0.95),
        reference_levelled=sum(wanted[m.name].levelled_by is not None for m in matches),
        detected_levelled=sum(found[m.name].levelled_by is not None for m in matches),
        reference_level=projection is not None and projection.reference_level,
        reference_whole_pixels=_at_whole_pixels(matches),
        pairs=pairs,
    )


def _at_whole_pixels(matches: Iterable[FrameMatch]) -> bool:
    """Whether all matched reference rows are at whole pixels, like those of the data set."""
    seen = [m.projection.reference_px(circle_arrays(m.wanted).xy) for m in matches if m.projection]
    px = np.concatenate([np.zeros((0, 2)), *seen])
    return len(px) > 0 and bool(np.abs(px - np.rint(px)).max() < _WHOLE_PX)


def _image_cost(matches: Iterable[FrameMatch]) -> float:
    """Sum of squared distances of matched discs in the images, in gates, and unmatched rows."""
    cost = [len(m.missed) + np.fmin((error_px(m) / LEAST_GATE_PX) ** 2, 1.0).sum() for m in matches]
    return float(np.sum(cost))


def _levelled_xy(rows: Sequence[CircleLandmark], projection: DiscProjection | None) -> FloatArray:
    """(M, 2) floor positions of reference discs, levelled as the detected ones are."""
    xy = circle_arrays(rows).xy
    return xy if projection is None else projection.levelled_as_detected(xy)


def compare_line_frames(
    reference: Iterable[Frame],
    detected: Iterable[Frame],
    options: CompareOptions | None = None,
    *,
    unlisted: Iterable[Frame] | None = None,
    names: tuple[str, str] = ("reference", "detected"),
) -> LineComparison:
    """Compare the lines of two sets of frames, as `compare_frames`."""
    options = options or CompareOptions()
    sides = frames_by_image(reference, names[0]), frames_by_image(detected, names[1])
    matches = match_runs("lines", *sides, options, unlisted=unlisted)
    first = [row for match in matches for row in match.wanted]
    second = [row for match in matches for row in match.matched]

    def difference(name: str) -> FloatArray:
        return numbers(second, name) - numbers(first, name)

    bearing_rad, sigma_rad = numbers(first, "alpha"), numbers(second, "sigma")
    error_rad = wrap_angle(difference("alpha"))
    error_deg = np.degrees(np.abs(error_rad))
    variance = np.where(sigma_rad >= LEAST_SIGMA_RAD, sigma_rad**2, 0.0)
    ends = [np.hypot(difference(f"x{end}"), difference(f"y{end}")) for end in ("top", "bottom")]
    return LineComparison(
        **_rates(matches, *sides, options, names),
        on_lookalikes=None,
        normalised_error=normalised_error(error_rad[:, None], variance[:, None, None]),
        bearing_median_deg=quantile(error_deg),
        bearing_95_deg=quantile(error_deg, 0.95),
        ends_median=quantile(np.concatenate(ends)),
        beta_median_deg=quantile(np.degrees(np.abs(difference("beta")))),
        pairs=LinePairs(bearing_rad, error_rad, sigma_rad),
    )


def _distance_bin(
    low: float, high: float, sides: tuple[CircleArrays, ...], pairs: DiscPairs
) -> DistanceBin:
    """The bin of a range; `sides` are matched reference and detected rows, missed and extra."""
    inside = [(low <= -side.xy[:, 1]) & (-side.xy[:, 1] < high) for side in sides]
    first, second, missed, extra = (int(mask.sum()) for mask in inside)
    away = pairs.away[inside[0]]
    offset, as_written = pairs.offset[inside[0]], pairs.as_written[inside[0]]
    return DistanceBin(
        from_m=low if np.isfinite(low) else None,
        to_m=high if np.isfinite(high) else None,
        reference=first + missed,
        missed=missed,
        detected=second + extra,
        extra=extra,
        recall=first / (first + missed) if first + missed else None,
        precision=second / (second + extra) if second + extra else None,
        error_median_m=quantile(np.linalg.norm(offset, axis=1)),
        as_written=floor_difference(as_written, away),
        alike=floor_difference(offset, away) if pairs.levelled_apart else None,
    )


def _on_lookalikes(
    matches: Sequence[FrameMatch], lookalikes: Iterable[Frame] | None, options: CompareOptions
) -> int | None:
    """Number of extra rows on look-alikes; None if these are not known."""
    if lookalikes is None:
        return None
    known = {image_name(frame.step.prefix): frame.circles for frame in lookalikes}
    return sum(
        len(pair_discs(known[m.name], m.extra, options, m.projection).first)
        for m in matches
        if m.name in known
    )


def frames_by_image(frames: Iterable[Frame], name: str) -> dict[str, Frame]:
    """Frames by the names of their images; a CompareError naming the run if an image has two."""
    by_image: dict[str, Frame] = {}
    for frame in frames:
        image = image_name(frame.step.prefix)
        if image in by_image:
            raise CompareError(f"{name}: two frames of image {excerpt(image)}: expected one")
        by_image[image] = frame
    return by_image


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


def _rates(
    matches: tuple[FrameMatch, ...], reference: Mapping[str, Frame], detected: Mapping[str, Frame],
    options: CompareOptions, names: tuple[str, str],
) -> dict[str, Any]:  # fmt: skip
    """The fields of a `Comparison` that count rows and frames."""
    counts: dict[str, int] = {
        name: sum(len(getattr(match, name)) for match in matches)
        for name in ("matched", "joined", "missed", "extra", "set_aside")
    }
    matched, extra = counts["matched"], counts["extra"]
    found = matched + counts["joined"]
    wanted = found + counts["missed"]
    return {
        "reference_name": names[0],
        "detected_name": names[1],
        "options": options,
        "reference": wanted,
        "detected": matched + extra,
        "found": found,
        **counts,
        "recall": found / wanted if wanted else None,
        "precision": matched / (matched + extra) if matched + extra else None,
        "frames": matches,
        "frames_only_in_reference": tuple(name for name in reference if name not in detected),
        "frames_only_in_detected": tuple(name for name in detected if name not in reference),
    }


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
    first, left = ([counted[i] for i in side] for side in (pairs.first, pairs.first_alone))
    second, alone = ([found[j] for j in side] for side in (pairs.second, pairs.second_alone))
    aside = pair_up(uncounted, alone)
    if kind == "lines":
        reach = numbers(second, "sigma") * options.sigmas
        joined = np.asarray((np.abs(_turns(left, second)) <= reach).any(axis=1))
        errors = np.degrees(np.abs(wrap_angle(numbers(second, "alpha") - numbers(first, "alpha"))))
    else:
        joined = np.zeros(len(left), dtype=np.bool_)
        first_xy = _levelled_xy(first, projection)
        errors = np.linalg.norm(circle_arrays(second).xy - first_xy, axis=1)
    return FrameMatch(
        name,
        projection,
        found,
        wanted=first,
        matched=second,
        joined=[row for row, with_another in zip(left, joined) if with_another],
        missed=[row for row, with_another in zip(left, joined) if not with_another],
        extra=[alone[j] for j in aside.second_alone],
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
    difference = _turns(reference, detected)
    by_sigma = numbers(detected, "sigma") * options.sigmas
    gate = np.maximum(np.radians(options.tolerance_deg), by_sigma)
    return associate(difference**2, np.abs(difference) <= gate)


def error_px(match: FrameMatch) -> FloatArray:
    """(M,) distances of matched discs in the image; NaN if one is not visible."""
    projection = match.projection
    assert projection is not None
    first, second = (circle_arrays(rows).xy for rows in (match.wanted, match.matched))
    between = projection.detected_px(second) - projection.reference_px(first)
    return np.asarray(np.linalg.norm(between, axis=1))


def numbers(rows: Sequence[Any], name: str) -> FloatArray:
    """(N,) one number of each row."""
    return np.array([getattr(row, name) for row in rows], dtype=np.float64)


def _turns(reference: Sequence[LineLandmark], detected: Sequence[LineLandmark]) -> FloatArray:
    """(N, M) bearings of detected lines minus those of reference lines (rad)."""
    return wrap_angle(numbers(detected, "alpha") - numbers(reference, "alpha")[:, np.newaxis])
