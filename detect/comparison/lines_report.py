"""A comparison of lines as text for people and as JSON for programs."""

from __future__ import annotations

import json
from dataclasses import asdict

from rich.console import Group
from rich.table import Table
from rich.text import Text

from detect.comparison.lines_result import LineComparison
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


def line_comparison_tables(comparison: LineComparison) -> Group:
    """Format a comparison for a rich console, which omits colour if there is no terminal.

    Parameters
    ----------
    comparison : LineComparison
        The figures.

    Returns
    -------
    rich.console.Group
        Summary and the worst frames.
    """
    if not (comparison.reference or comparison.detected):
        return Group(_summary(comparison))
    return Group(_summary(comparison), "", _worst_frames(comparison))


def format_line_text(comparison: LineComparison, *, width: int = 100) -> str:
    """Format a comparison as plain text of at most `width` columns, without colour."""
    return plain_text(line_comparison_tables(comparison), width)


def format_line_json(comparison: LineComparison) -> str:
    """Write a comparison as JSON: same keys in the same order, numbers finite or null.

    Angles are in degrees. Of the frames, the worst are listed, and those that only one file has.
    """
    figures = {
        **asdict(comparison),
        "found": comparison.found,
        "missed": comparison.missed,
        "extra": comparison.extra,
        "frames": len(comparison.frames),
        "worst_frames": [asdict(frame) for frame in comparison.worst_frames(_WORST_FRAMES)],
    }
    return json.dumps(figures, indent=2, allow_nan=False) + "\n"


def _summary(c: LineComparison) -> Table:
    gate = f"{c.options.tolerance_deg:g} deg or {c.options.sigmas:g} sigma"
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
        (
            f"within {gate}",
            f"{c.matched} matched, {c.joined} more joined with them, {c.missed} missed, "
            f"{c.extra} extra",
        ),
        ("recall", number(c.recall, 4)),
        ("precision", number(c.precision, 4)),
        (
            "bearing error",
            f"median {number(c.bearing_median_deg, 4)} deg, 95 % {number(c.bearing_95_deg, 4)} deg",
        ),
        ("normalised error", _normalised_error(c)),
        ("beta error", f"median {number(c.beta_median_deg, 4)} deg"),
        ("distance of ends", f"median {number(c.ends_median, 4)} (normalised coordinates)"),
    )
    return summary_table(rows)


def _normalised_error(c: LineComparison) -> str:
    text = normalised_error_text(c.normalised_error)
    if c.normalised_error.left_out:
        text += f"; {c.normalised_error.left_out} without a positive sigma left out"
    return text


def _worst_frames(c: LineComparison) -> Table:
    table = titled_table("Worst frames")
    table.add_column("image", overflow="fold")
    for heading in ("matched", "joined", "missed", "extra", "largest error deg"):
        table.add_column(heading, justify="right")
    for frame in c.worst_frames(_WORST_FRAMES):
        table.add_row(
            Text(printable(frame.name)),
            str(frame.matched),
            str(frame.joined),
            str(frame.missed),
            str(frame.extra),
            number(frame.largest_error_deg, 3),
        )
    return table
