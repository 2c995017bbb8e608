"""A comparison as text for people and as JSON for programs."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

from rich.console import Group
from rich.table import Table
from rich.text import Text

from detect.comparison.result import (
    NO_PAIRS,
    CommonLean,
    Comparison,
    DistanceBin,
    FloorBin,
    Levelling,
)
from detect.comparison.tables import (
    frames_text,
    normalised_error_text,
    number,
    plain_text,
    printable,
    rows_text,
    summary_table,
    titled_table,
)

_WORST_FRAMES = 10


def comparison_tables(comparison: Comparison) -> Group:
    """Format a comparison for a rich console, which omits colour if there is no terminal.

    Parameters
    ----------
    comparison : Comparison
        The figures.

    Returns
    -------
    rich.console.Group
        Summary, figures over distance, and the worst frames.
    """
    if not (comparison.reference or comparison.detected):
        return Group(_summary(comparison))
    floor = [] if comparison.lean is None else [_floor_differences(comparison)]
    return Group(
        _summary(comparison),
        "",
        _over_distance(comparison),
        *floor,
        _worst_frames(comparison),
    )


def format_text(comparison: Comparison, *, width: int = 100) -> str:
    """Format a comparison as plain text of at most `width` columns, without colour."""
    return plain_text(comparison_tables(comparison), width)


def format_json(comparison: Comparison) -> str:
    """Write a comparison as JSON: same keys in the same order, numbers finite or null.

    Lengths are in metres. Of the frames, the worst are listed, and those that only one file has.
    """
    figures = {
        **asdict(replace(comparison, pairs=NO_PAIRS)),
        "missed": comparison.missed,
        "extra": comparison.extra,
        "bins": [
            {**asdict(part), "quality_difference": part.quality_difference}
            for part in comparison.bins
        ],
        "frames": len(comparison.frames),
        "pairs": comparison.matched,
        "worst_frames": [asdict(frame) for frame in comparison.worst_frames(_WORST_FRAMES)],
    }
    return json.dumps(figures, indent=2, allow_nan=False) + "\n"


def _summary(c: Comparison) -> Table:
    counts = f"{c.matched} matched, {c.missed} missed, {c.extra} extra"
    if c.on_lookalikes is not None:
        counts += f": {c.on_lookalikes} on look-alikes, {c.extra - c.on_lookalikes} elsewhere"
    if c.in_image:
        where = "in the image"
        gate = f" (within half the disc's image or {c.options.least_px:g} px)"
    else:
        measure = (
            f"{c.options.gate_m:g} m" if c.options.sigma is None else f"{c.options.sigma:g} sigma"
        )
        where, gate = f"within {measure}", ""
    rows = (
        ("reference", printable(c.reference_name)),
        ("detected", printable(c.detected_name)),
        (
            "frames",
            frames_text(
                len(c.frames),
                len(c.frames_only_in_reference),
                len(c.frames_only_in_detected),
                counted=c.options.all_frames,
            ),
        ),
        (
            "rows",
            rows_text(
                c.reference, c.detected, c.set_aside, only_identified=c.options.only_identified
            ),
        ),
        *([("levelled", levelling_text(c))] if _any_levelled(c) else []),
        (where, counts + gate),
        ("recall", number(c.recall, 4)),
        ("precision", number(c.precision, 4)),
        *(
            [("image difference", _median_and_most(c.image_median_px, c.image_95_px, 2, "px"))]
            if c.in_image
            else []
        ),
        ("position error", _median_and_most(c.error_median_m, c.error_95_m, 4, "m")),
        ("normalised error", _normalised_error(c)),
        *([] if c.lean is None else [("common lean", lean_text(c.lean))]),
        (
            "reference quality",
            f"median {number(c.reference_quality_matched, 3)} matched, "
            f"{number(c.reference_quality_missed, 3)} missed",
        ),
        (
            "detected quality",
            f"median {number(c.detected_quality_matched, 3)} matched, "
            f"{number(c.detected_quality_extra, 3)} extra",
        ),
    )
    return summary_table(rows)


def levelling_text(c: Comparison) -> str:
    """One sentence on which side's rows are levelled."""
    reference, detected = (
        _levelled_side(name, side)
        for name, side in (
            ("reference", c.reference_levelling),
            ("detected", c.detected_levelling),
        )
    )
    held = "compared at the pixels where they were seen" if c.in_image else "compared on the floor"
    return f"{reference}; {detected}: {held}"


def _levelled_side(name: str, side: Levelling) -> str:
    if side.pitch_deg is None or side.roll_deg is None:
        if side.true:
            return f"{name} rows are level"
        return f"{name} rows are where the camera as calibrated saw them"
    which = "all" if side.levelled == side.frames else f"{side.levelled} of {side.frames}"
    return (
        f"{name} rows are levelled in {which} frames "
        f"(medians: pitch {side.pitch_deg:.2f}, roll {side.roll_deg:.2f} deg)"
    )


def _any_levelled(c: Comparison) -> bool:
    sides = (c.reference_levelling, c.detected_levelling)
    return any(side.levelled or side.true for side in sides)


def lean_text(lean: CommonLean) -> str:
    """Tilt and height that would explain the differences on the floor, and the residuals."""
    left = _median_and_most(lean.left.median_m, lean.left.most_m, 4, "m")
    return (
        f"pitch {lean.pitch_deg:.3f} +- {lean.pitch_sigma_deg:.3f} deg, "
        f"roll {lean.roll_deg:.3f} +- {lean.roll_sigma_deg:.3f} deg, "
        f"height {100 * lean.raised_m:+.2f} +- {100 * lean.raised_sigma_m:.2f} cm would turn "
        f"reference positions into detected ones; left after it: {left}, "
        f"normalised error {number(lean.normalised_error.per_dof, 3)}"
    )


def _median_and_most(median: float | None, most: float | None, decimals: int, unit: str) -> str:
    return f"median {number(median, decimals)} {unit}, 95 % {number(most, decimals)} {unit}"


def _normalised_error(c: Comparison) -> str:
    error = c.normalised_error
    text = normalised_error_text(error)
    source = {"detected": "detected", "reference": "reference", "sum": "detected plus reference"}
    text += f", covariance: {source[c.options.error_covariance]}"
    if error.left_out:
        text += f"; {error.left_out} not positive definite left out"
    return text


def _over_distance(c: Comparison) -> Table:
    table = titled_table("By forward distance (position error and quality: medians)")
    for heading in (
        # Of a width that a terminal of 80 columns has.
        "metres", "ref.", "missed", "recall", "det.", "extra", "prec.",
        "error m", "ref. quality", "det. quality", "diff.",
    ):  # fmt: skip
        table.add_column(heading, justify="right")
    for part in c.bins:
        if part.reference == part.detected == 0:
            continue
        table.add_row(
            _range(part),
            str(part.reference),
            str(part.missed),
            number(part.recall, 3),
            str(part.detected),
            str(part.extra),
            number(part.precision, 3),
            number(part.error_median_m, 3),
            number(part.reference_quality_median, 3),
            number(part.detected_quality_median, 3),
            number(part.quality_difference, 3),
        )
    return table


def _floor_differences(c: Comparison) -> Table:
    table = titled_table(
        "On the floor, m: detected minus reference; the same after the common lean\n"
        "(along: farther away, across: to the left; medians)"
    )
    for heading in (
        "metres", "pairs", "median", "95 %", "along", "across",
        "after", "95 %", "along", "across",
    ):  # fmt: skip
        table.add_column(heading, justify="right")
    for part in c.floor:
        if part.before.pairs == 0 or part.after is None:
            continue
        figures = [
            number(value, 3)
            for one in (part.before, part.after)
            for value in (one.median_m, one.most_m, one.along_m, one.across_m)
        ]
        table.add_row(_range(part), str(part.before.pairs), *figures)
    return table


def _range(part: DistanceBin | FloorBin) -> str:
    if part.from_m is None:
        return f"< {part.to_m:g}"
    if part.to_m is None:
        return f">= {part.from_m:g}"
    return f"{part.from_m:g}-{part.to_m:g}"


def _worst_frames(c: Comparison) -> Table:
    table = titled_table("Worst frames")
    table.add_column("image", overflow="fold")
    for heading in ("matched", "missed", "extra", "largest error m"):
        table.add_column(heading, justify="right")
    for frame in c.worst_frames(_WORST_FRAMES):
        table.add_row(
            Text(printable(frame.name)),
            str(frame.matched),
            str(frame.missed),
            str(frame.extra),
            number(frame.largest_error_m, 3),
        )
    return table
