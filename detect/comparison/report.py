"""The command ``detect compare``: compares detected rows with reference rows."""

from __future__ import annotations

import sys
from dataclasses import astuple
from typing import NamedTuple

from rich import box
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from camera import Camera, camera_in, read_camera
from detect.comparison.compare import compare_with_file
from detect.comparison.result import (
    WORST_FRAMES,
    CommonLean,
    Comparison,
    DiscComparison,
    Kind,
    LineComparison,
    NormalisedError,
    number,
    unmet_demands,
)
from detect.drawing.inputs import read_head
from detect.errors import DetectError
from detect.seen import LEAST_GATE_PX, Sight
from detect.viewing_options import Compare
from redetect.landmarks import read_frames
from redetect.storage import write_bytes
from redetect.storage.command_line import EXIT_ERROR
from redetect.storage.messages import one_line


def perform(command: Compare) -> int:
    """Compare rows with reference rows; returns the exit code."""
    result = comparison_of(command)
    if isinstance(result, DiscComparison) and not (result.in_image or command.matching.gate_m):
        print("no calibration: positions are compared on the floor; --camera names one")
    Console().print(comparison_tables(result))
    if command.json is not None:
        write_bytes(command.json, result.to_json().encode(), overwrite=command.force)
    unmet = unmet_demands(
        result, min_recall=command.min_recall, min_precision=command.min_precision
    )
    for sentence in unmet:
        print(sentence, file=sys.stderr)
    return EXIT_ERROR if unmet else 0


def comparison_of(command: Compare, camera: Camera | None = None) -> Comparison:
    """The comparison that a command asks for; with a camera, if it isn't named by its file."""
    kind: Kind = "lines" if command.lines else "circles"
    reference = command.reference or command.run / f"map.{kind}"
    detected = command.detected or command.run / f"detected.{kind}"
    for path, advice in (
        (reference, "give the reference rows with --reference"),
        (detected, f"`detect {kind}` writes it, --detected names another"),
    ):
        if not path.exists():
            raise DetectError(f"{path}: no such landmark file: {advice}")
    sight = None
    if not command.lines:
        if camera is None:
            at = command.camera
            camera = camera_in(command.run) if at is None else read_camera(at)
        radius_m = read_head(detected).circle_settings.radius_m
        sight = None if camera is None else Sight(camera, radius_m, read_head(reference).level)
    return compare_with_file(
        kind,
        reference,
        read_frames(detected),
        command.matching,
        sight=sight,
        unlisted=command.unlisted,
        names=(str(reference), str(detected)),
    )


class FigureTable(NamedTuple):
    """Figures as words in rows, for a terminal or a page."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def comparison_tables(comparison: Comparison) -> Group:
    """Format a comparison for a rich console, which omits colour if there is no terminal.

    It has a summary, figures over distance (of discs), and the worst frames.
    """
    summary = Table(box=None, show_header=False, pad_edge=False)
    summary.add_column(style="bold", no_wrap=True)
    summary.add_column(overflow="fold")
    for name, value in summary_rows(comparison).items():
        summary.add_row(name, Text(value))
    tables: list[Table | str] = [summary]
    if comparison.reference or comparison.detected:
        tables.append("")
        if isinstance(comparison, DiscComparison):
            tables.append(_rich_table(_over_distance(comparison)))
            if comparison.lean is not None:
                tables.append(_rich_table(floor_table(comparison)))
        tables.append(_rich_table(worst_frames_table(comparison, WORST_FRAMES)))
    return Group(*tables)


def summary_rows(c: Comparison) -> dict[str, str]:
    """Names and words: what was found first, then how it was compared and how large errors are."""
    only = c.options.only_identified
    on_lookalikes = c.on_lookalikes
    joined = f", {c.joined} of them by a row that represents several" if c.joined else ""
    rows = {
        "found": f"{c.found} of {c.reference} reference rows{joined}",
        "missed": f"{c.missed} of {c.reference} reference rows",
    }
    if on_lookalikes is not None:
        of = f"{on_lookalikes} of {c.detected} detected rows"
        rows["look-alikes"] = f"{of}: on things known to look like a disc"
        clutter = c.extra - on_lookalikes
        rows["clutter"] = f"{clutter} of {c.detected} detected rows: on nothing known"
    else:
        rows["extra"] = f"{c.extra} of {c.detected} detected rows: on no reference row"
        if isinstance(c, DiscComparison) and c.extra_beyond:
            rows["extra"] += f", {c.extra_beyond} of them farther away than any that is on one"
    if c.set_aside:
        kind = "discs" if isinstance(c, DiscComparison) else "lines"
        what = "what has no ID or is not listed" if only else f"{kind} in view that are not listed"
        rows["not counted"] = f"{c.set_aside} more detected rows: on {what}"
    rows |= {
        "recall": number(c.recall, 4),
        "precision": number(c.precision, 4),
        "reference": one_line(c.reference_name) + (", rows with an ID only" if only else ""),
        "detected": one_line(c.detected_name),
        "frames": f"{len(c.frames)} compared; {len(c.frames_only_in_reference)} only in the "
        f"reference, {len(c.frames_only_in_detected)} only detected (not counted)",
    }
    if isinstance(c, DiscComparison):
        rows |= _disc_rows(c)
    elif isinstance(c, LineComparison):
        error = _normalised_error(c.normalised_error, "without a positive sigma")
        rows |= {
            "same line": f"within {c.options.tolerance_deg:g} deg or {c.options.sigmas:g} sigma",
            "bearing error": _median_and_most(c.bearing_median_deg, c.bearing_95_deg, 4, "deg"),
            "normalised error": error,
            "beta error": f"median {number(c.beta_median_deg, 4)} deg",
            "distance of ends": f"median {number(c.ends_median, 4)} (normalised coordinates)",
        }
    return rows


def _disc_rows(c: DiscComparison) -> dict[str, str]:
    rows = {}
    if c.reference_levelled or c.detected_levelled:
        how = "at the pixels where they were seen" if c.in_image else "on the floor"
        rows["levelled"] = (
            f"reference rows of {c.reference_levelled} frames, detected rows of "
            f"{c.detected_levelled}: compared {how}"
        )
    if c.in_image:
        same = f"in the image, within half the disc's image or {LEAST_GATE_PX:g} px"
        apart = _median_and_most(c.image_median_px, c.image_95_px, 2, "px")
        rows |= {"same disc": same, "image difference": apart}
    else:
        rows["same disc"] = f"on the floor, within {c.options.gate_m:g} m"
    rows["position error"] = _median_and_most(c.error_median_m, c.error_95_m, 4, "m")
    rows["normalised error"] = _normalised_error(c.normalised_error, "not positive definite")
    if c.lean is not None:
        rows["common lean"] = _lean_text(c.lean)
    for side, matched, fate, alone in (
        ("reference", c.reference_quality_matched, "missed", c.reference_quality_missed),
        ("detected", c.detected_quality_matched, "extra", c.detected_quality_extra),
    ):
        text = f"median {number(matched, 3)} matched, {number(alone, 3)} {fate}"
        rows[f"{side} quality"] = text
    return rows


def _lean_text(lean: CommonLean) -> str:
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


def _normalised_error(error: NormalisedError, unusable: str) -> str:
    """How large normalised errors are, and how large they should be."""
    text = number(error.per_dof, 3)
    if error.band is not None:
        low, high = error.band
        text += f" squared per degree of freedom (95 % band {low:.3f} to {high:.3f}),"
        text += " as if the reference had no errors"
    left_out = f"; {error.left_out} {unusable} left out" if error.left_out else ""
    return text + left_out


def _over_distance(c: DiscComparison) -> FigureTable:
    # Of a width that a terminal of 80 columns has.
    head = (
        "metres", "ref.", "missed", "recall", "det.", "extra", "prec.",
        "error m", "ref. quality", "det. quality", "diff.",
    )  # fmt: skip
    rows = []
    for part in c.bins:
        if part.reference or part.detected:
            figures = (
                part.recall, part.precision, part.error_median_m, part.reference_quality_median,
                part.detected_quality_median, part.quality_difference,
            )  # fmt: skip
            recall, precision, *medians = (number(value, 3) for value in figures)
            counts = [str(n) for n in (part.reference, part.missed, part.detected, part.extra)]
            rows.append((str(part), *counts[:2], recall, *counts[2:], precision, *medians))
    caption = "By forward distance (position error and quality: medians)"
    return FigureTable(caption, head, tuple(rows))


def floor_table(c: DiscComparison) -> FigureTable:
    """Differences on the floor by forward distance, before and after the common lean."""
    rows = []
    for part in c.bins:
        if part.before.pairs and part.after is not None:
            figures = [*astuple(part.before)[1:], *astuple(part.after)[1:]]
            shown = (number(value, 3) for value in figures)
            rows.append((str(part), str(part.before.pairs), *shown))
    caption = (
        "On the floor, m: detected minus reference; the same after the common lean\n"
        "(along: farther away, across: to the left; medians)"
    )
    head = ("median", "95 %", "along", "across")
    return FigureTable(caption, ("metres", "pairs", *head, "after", *head[1:]), tuple(rows))


def worst_frames_table(c: Comparison, most: int) -> FigureTable:
    """The frames with most missed and extra rows."""
    rows = tuple(
        (
            match.frame.name,
            *(str(len(getattr(match, count))) for count in c.counts),
            number(match.largest_error, 3),
        )
        for match in c.worst_frames(most)
    )
    head = ("image", *c.counts, f"largest error {c.unit}")
    return FigureTable("Worst frames", head, rows)


def _rich_table(figures: FigureTable) -> Table:
    table = Table(title=figures.caption, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    for k, heading in enumerate(figures.head):
        table.add_column(heading, justify="right" if k else "left", overflow="fold")
    for row in figures.rows:
        table.add_row(*(Text(one_line(word)) for word in row))
    return table
