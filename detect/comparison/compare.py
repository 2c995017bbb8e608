"""Compares detected discs, or lines, with reference rows of the same run.

Discs are paired in the image, or on the floor; lines by bearing. Differences of paired discs on the
floor are computed for the rows as written, and after levelling both by the tilt of the detected
ones. A detected line can represent several: unpaired reference lines within its sigma are found.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from camera import Camera, camera_in, read_camera
from detect.comparison.matching import (
    FLOOR_GATE_M,
    error_px,
    levelled_xy,
    match_runs,
    numbers,
    pair_discs,
)
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
    CircleArrays,
    Frame,
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
        for side in ("matched_reference", "matched", "missed", "extra")
    )
    levelled = [levelled_xy(match.matched_reference, match.projection) for match in matches]
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
    rows = [(m.projection, circle_arrays(m.matched_reference)) for m in matches]
    seen = [projection.reference_px(discs.xy) for projection, discs in rows if projection]
    px = np.concatenate([np.zeros((0, 2)), *seen])
    return len(px) > 0 and bool(np.abs(px - np.rint(px)).max() < _WHOLE_PX)


def _image_cost(matches: Iterable[FrameMatch]) -> float:
    """Sum of squared distances of matched discs in the images, in gates, and unmatched rows."""
    cost = [len(m.missed) + np.fmin((error_px(m) / LEAST_GATE_PX) ** 2, 1.0).sum() for m in matches]
    return float(np.sum(cost))


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
    first = [row for match in matches for row in match.matched_reference]
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
