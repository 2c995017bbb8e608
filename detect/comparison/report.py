"""A comparison as text for people and as JSON for programs."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, replace

from rich import box
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
    LineComparison,
    NormalisedError,
)

NONE = "-"
_WORST_FRAMES = 10


def comparison_tables(comparison: Comparison | LineComparison) -> Group:
    """Format a comparison for a rich console, which omits colour if there is no terminal.

    Parameters
    ----------
    comparison : Comparison or LineComparison
        The figures.

    Returns
    -------
    rich.console.Group
        Summary, figures over distance (of discs), and the worst frames.
    """
    tables = [_summary(comparison)]
    if comparison.reference or comparison.detected:
        if isinstance(comparison, Comparison):
            tables.append(_over_distance(comparison))
            tables += [] if comparison.lean is None else [_floor_differences(comparison)]
        tables.append(_worst_frames(comparison))
    return Group(tables[0], *([""] if tables[1:] else []), *tables[1:])


def format_json(comparison: Comparison | LineComparison) -> str:
    """Write a comparison as JSON: same keys in the same order, numbers finite or null.

    Lengths are in metres, angles in degrees. Of the frames, the worst are listed, and those that
    only one file has.
    """
    if isinstance(comparison, Comparison):
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
        }
    else:
        figures = {
            **asdict(comparison),
            "found": comparison.found,
            "missed": comparison.missed,
            "extra": comparison.extra,
            "frames": len(comparison.frames),
        }
    figures["worst_frames"] = [asdict(frame) for frame in comparison.worst_frames(_WORST_FRAMES)]
    return json.dumps(figures, indent=2, allow_nan=False) + "\n"


def _summary(c: Comparison | LineComparison) -> Table:
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    rows = [
        ("reference", printable(c.reference_name)),
        ("detected", printable(c.detected_name)),
        (
            "frames",
            f"{len(c.frames)} compared; {len(c.frames_only_in_reference)} only in the reference, "
            f"{len(c.frames_only_in_detected)} only detected "
            f"({'counted' if c.options.all_frames else 'not counted'})",
        ),
        ("rows", _rows_text(c)),
        *(_disc_rows(c) if isinstance(c, Comparison) else _line_rows(c)),
    ]
    for name, value in rows:
        table.add_row(name, Text(value))
    return table


def _rows_text(c: Comparison | LineComparison) -> str:
    text = f"{c.reference} reference, {c.detected} detected"
    if c.options.only_identified:
        text += f" (with an ID only; {c.set_aside} on rows without one set aside)"
    elif c.set_aside:
        text += f" ({c.set_aside} more on what is in view but not listed: neither right nor wrong)"
    return text


def _line_rows(c: LineComparison) -> list[tuple[str, str]]:
    return [
        (
            f"within {c.options.tolerance_deg:g} deg or {c.options.sigmas:g} sigma",
            f"{c.matched} matched, {c.joined} more joined with them, {c.missed} missed, "
            f"{c.extra} extra",
        ),
        ("recall", number(c.recall, 4)),
        ("precision", number(c.precision, 4)),
        ("bearing error", _median_and_most(c.bearing_median_deg, c.bearing_95_deg, 4, "deg")),
        (
            "normalised error",
            _normalised_error(c.normalised_error, "", "without a positive sigma"),
        ),
        ("beta error", f"median {number(c.beta_median_deg, 4)} deg"),
        ("distance of ends", f"median {number(c.ends_median, 4)} (normalised coordinates)"),
    ]


def _disc_rows(c: Comparison) -> list[tuple[str, str]]:
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
    covariance = c.options.error_covariance
    source = "detected plus reference" if covariance == "sum" else covariance
    return [
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
        (
            "normalised error",
            _normalised_error(
                c.normalised_error, f", covariance: {source}", "not positive definite"
            ),
        ),
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
    ]


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


def _normalised_error(error: NormalisedError, covariance: str, unusable: str) -> str:
    """How large normalised errors are, and how large they should be."""
    text = NONE
    if error.band is not None:
        low, high = error.band
        text = (
            f"{number(error.per_dof, 3)} squared per degree of freedom "
            f"(95 % band {low:.3f} to {high:.3f})"
        )
    left_out = f"; {error.left_out} {unusable} left out" if error.left_out else ""
    return text + covariance + left_out


def _over_distance(c: Comparison) -> Table:
    # Of a width that a terminal of 80 columns has.
    headings = (
        "metres", "ref.", "missed", "recall", "det.", "extra", "prec.",
        "error m", "ref. quality", "det. quality", "diff.",
    )  # fmt: skip
    table = _titled_table("By forward distance (position error and quality: medians)", headings)
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
    headings = ("median", "95 %", "along", "across")
    table = _titled_table(
        "On the floor, m: detected minus reference; the same after the common lean\n"
        "(along: farther away, across: to the left; medians)",
        ("metres", "pairs", *headings, "after", *headings[1:]),
    )
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


def _worst_frames(c: Comparison | LineComparison) -> Table:
    discs = isinstance(c, Comparison)
    counts = ("matched", "missed", "extra") if discs else ("matched", "joined", "missed", "extra")
    table = _titled_table("Worst frames")
    table.add_column("image", overflow="fold")
    for heading in (*counts, f"largest error {'m' if discs else 'deg'}"):
        table.add_column(heading, justify="right")
    for frame in c.worst_frames(_WORST_FRAMES):
        numbers = [str(getattr(frame, count)) for count in counts]
        table.add_row(Text(printable(frame.name)), *numbers, number(frame.largest_error, 3))
    return table


def _titled_table(title: str, headings: Iterable[str] = ()) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    for heading in headings:
        table.add_column(heading, justify="right")
    return table


def number(value: float | None, decimals: int) -> str:
    """A figure, or a dash where there is none."""
    if value is None:
        return NONE
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # adding 0 makes -0 a 0


def printable(name: str) -> str:
    """A name from a file, with control characters escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in name)
