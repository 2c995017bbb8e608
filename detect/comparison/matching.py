"""Pairs rows of two runs: frames by image, rows one to one.

Discs are paired in the image, each where it was seen, or on the floor; lines by bearing. A detected
line can represent several that were joined: unpaired reference lines within its sigma are found,
too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detect.comparison.result import (
    CompareError,
    CompareOptions,
    Comparison,
    FrameMatch,
    FramePair,
    Kind,
)
from detect.seen import Sight
from detect.sources.image_names import image_name
from redetect.landmarks import (
    Association,
    CircleLandmark,
    Frame,
    LineLandmark,
    associate,
    associate_positions,
    associate_within_covariance,
    circle_arrays,
    is_positive_definite,
    wrap_angle,
)

FloatArray = NDArray[np.float64]

#: Of discs that are compared on the floor, where nothing else is said (m).
FLOOR_GATE_M = 0.10
_LONGEST_SHOWN_NAME = 80
# Equally good pairs of lines must not depend on the file's order.
_line_order = attrgetter("alpha", "sigma", "beta", "xtop", "ytop", "xbottom", "ybottom", "ids")


def frames_by_image(frames: Iterable[Frame], name: str) -> dict[str, Frame]:
    """Frames by the names of their images; CompareError calls the run `name` if one has two."""
    by_image: dict[str, Frame] = {}
    for frame in frames:
        image = image_name(frame.step.prefix)
        if image in by_image:
            raise CompareError(f"{name}: two frames of image {_shown(image)}: expected one")
        by_image[image] = frame
    return by_image


def match_runs(
    kind: Kind,
    reference: Mapping[str, Frame],
    detected: Mapping[str, Frame],
    options: CompareOptions,
    names: tuple[str, str],
    sight: Sight | None = None,
    unlisted: Mapping[str, Frame] | None = None,
) -> Comparison:
    """Match the rows of two runs, image by image.

    Images are in the order of the reference, then those of `detected` alone, if they count.
    """
    images = [name for name in reference if options.all_frames or name in detected]
    if options.all_frames:
        images += [name for name in detected if name not in reference]
    matches = []
    for name in images:
        frames = reference.get(name), detected.get(name)
        view = None if sight is None else sight.of(*frames)
        pair = pair_of(kind, name, *frames, (unlisted or {}).get(name), view)
        matches.append(match_frame(pair, options))
    counts: dict[str, Any] = {
        name: sum(len(getattr(match, name)) for match in matches)
        for name in ("matched", "joined", "missed", "extra", "set_aside")
    }
    found, detected_rows = counts["matched"] + counts["joined"], counts["matched"] + counts["extra"]
    wanted = found + counts["missed"]
    return Comparison(
        *names,
        options,
        reference=wanted,
        detected=detected_rows,
        found=found,
        **counts,
        recall=found / wanted if wanted else None,
        precision=counts["matched"] / detected_rows if detected_rows else None,
        frames=tuple(matches),
        frames_only_in_reference=tuple(name for name in reference if name not in detected),
        frames_only_in_detected=tuple(name for name in detected if name not in reference),
    )


def pair_of(
    kind: Kind,
    name: str,
    reference: Frame | None,
    detected: Frame | None,
    unlisted: Frame | None = None,
    view: Sight | None = None,
) -> FramePair:
    """The discs or the lines of two frames of one image; a frame that is None has no rows."""

    def rows_of(frame: Frame | None) -> Sequence[Any]:
        rows = () if frame is None else getattr(frame, kind)
        return sorted(rows, key=_line_order) if kind == "lines" else rows

    return FramePair(kind, name, rows_of(reference), rows_of(detected), rows_of(unlisted), view)


def match_frame(frame: FramePair, options: CompareOptions) -> FrameMatch:
    """Match the rows of one frame one to one.

    Detected rows that fit an unlisted disc (or a reference row without ID, if these do not count),
    and no reference row that counts, are set aside. Raises CompareError if the gate needs a
    reference disc's covariance and that is not positive definite.
    """
    pair_up: Callable[..., Association] = partial(pair_lines, options=options)
    if frame.kind == "circles":
        _demand_measurable(frame, options)
        pair_up = partial(pair_discs, options=options, view=frame.view)
    counted, uncounted = frame.reference, list(frame.unlisted)
    if options.only_identified:
        uncounted += [row for row in counted if not row.identified]
        counted = [row for row in counted if row.identified]
    pairs = pair_up(counted, frame.detected)
    first, left = ([counted[i] for i in side] for side in (pairs.first, pairs.first_alone))
    second = [frame.detected[j] for j in pairs.second]
    alone = [frame.detected[j] for j in pairs.second_alone]
    aside = pair_up(uncounted, alone)
    if frame.kind == "lines":
        reach = numbers(second, "sigma") * options.sigmas
        joined = np.asarray((np.abs(_turns(left, second)) <= reach).any(axis=1))
        errors = np.degrees(np.abs(wrap_angle(numbers(second, "alpha") - numbers(first, "alpha"))))
    else:
        joined = np.zeros(len(left), dtype=np.bool_)
        errors = np.linalg.norm(circle_arrays(second).xy - circle_arrays(first).xy, axis=1)
    return FrameMatch(
        frame,
        matched=list(zip(first, second)),
        joined=[row for row, with_another in zip(left, joined) if with_another],
        missed=[row for row, with_another in zip(left, joined) if not with_another],
        extra=[alone[j] for j in aside.second_alone],
        set_aside=[alone[j] for j in np.sort(aside.second)],
        errors=np.asarray(errors),
    )


def pair_discs(
    reference: Sequence[CircleLandmark],
    detected: Sequence[CircleLandmark],
    options: CompareOptions,
    view: Sight | None = None,
) -> Association:
    """Pair discs of one frame one to one: as many as possible, with least squared distances.

    In the image where there is a view, unless the options ask for the floor.
    """
    first, second = circle_arrays(reference), circle_arrays(detected)
    if view is not None and not options.on_floor:
        seen, again = view.reference_px(first.xy), view.detected_px(second.xy)
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


def pair_lines(
    reference: Sequence[LineLandmark], detected: Sequence[LineLandmark], options: CompareOptions
) -> Association:
    """Pair lines of one frame one to one by bearing, with least squared differences.

    The gate is the larger of the tolerance and a multiple of the detected row's sigma.
    """
    difference = _turns(reference, detected)
    gate = np.maximum(
        np.radians(options.tolerance_deg), numbers(detected, "sigma") * options.sigmas
    )
    return associate(difference**2, np.abs(difference) <= gate)


def apart_px(match: FrameMatch) -> FloatArray:
    """(M,) distances of matched discs in the image; NaN where one is not seen."""
    view = match.frame.view
    assert view is not None
    first, second = (circle_arrays(rows).xy for rows in match.paired)
    return np.asarray(np.linalg.norm(view.detected_px(second) - view.reference_px(first), axis=1))


def numbers(rows: Sequence[Any], name: str) -> FloatArray:
    """(N,) one number of each row."""
    return np.array([getattr(row, name) for row in rows], dtype=np.float64)


def _turns(reference: Sequence[LineLandmark], detected: Sequence[LineLandmark]) -> FloatArray:
    """(N, M) bearings of detected lines less those of reference lines (rad)."""
    return wrap_angle(numbers(detected, "alpha") - numbers(reference, "alpha")[:, np.newaxis])


def _demand_measurable(frame: FramePair, options: CompareOptions) -> None:
    covariance = circle_arrays(frame.reference).covariance
    if options.sigma is not None and not is_positive_definite(covariance).all():
        raise CompareError(
            f"frame {_shown(frame.name)}: a reference row's covariance is not positive definite: "
            "expected one to measure sigmas in; a gate in metres needs none"
        )


def _shown(image: str) -> str:
    return repr(image[:_LONGEST_SHOWN_NAME])
