"""A comparison as text for people and as JSON for programs."""

from __future__ import annotations

import io
import json
from dataclasses import asdict

from rich import box
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from detect.compare_result import Comparison, DistanceBin

_WORST_FRAMES = 10
_NONE = "-"


def comparison_tables(comparison: Comparison) -> Group:
    """Lay a comparison out for a rich console, which leaves colour out where there is no terminal.

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
    return Group(_summary(comparison), "", _over_distance(comparison), _worst_frames(comparison))


def format_text(comparison: Comparison, *, width: int = 100) -> str:
    """Lay a comparison out as plain text of at most `width` columns, without colour."""
    stream = io.StringIO()
    console = Console(file=stream, width=width, color_system=None, force_terminal=False)
    console.print(comparison_tables(comparison))
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"


def format_json(comparison: Comparison) -> str:
    """Write a comparison as JSON: same keys in the same order, numbers finite or null.

    Lengths are in metres. Of the frames, the worst are listed, and those that only one file has.
    """
    figures = {
        **asdict(comparison),
        "missed": comparison.missed,
        "extra": comparison.extra,
        "bins": [
            {**asdict(part), "quality_difference": part.quality_difference}
            for part in comparison.bins
        ],
        "frames": len(comparison.frames),
        "worst_frames": [asdict(frame) for frame in comparison.worst_frames(_WORST_FRAMES)],
    }
    return json.dumps(figures, indent=2, allow_nan=False) + "\n"


def _summary(c: Comparison) -> Table:
    gate = f"{c.options.gate_m:g} m" if c.options.sigma is None else f"{c.options.sigma:g} sigma"
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")

    def add(name: str, value: str) -> None:
        table.add_row(name, Text(value))

    add("reference", _printable(c.reference_name))
    add("detected", _printable(c.detected_name))
    add(
        "frames",
        f"{len(c.frames)} compared; {len(c.frames_only_in_reference)} only in the reference, "
        f"{len(c.frames_only_in_detected)} only detected"
        f" ({'counted' if c.options.all_frames else 'not counted'})",
    )
    add("rows", f"{c.reference} reference, {c.detected} detected" + _set_aside(c))
    add(f"within {gate}", f"{c.matched} matched, {c.missed} missed, {c.extra} extra")
    add("recall", _number(c.recall, 4))
    add("precision", _number(c.precision, 4))
    add(
        "position error",
        f"median {_number(c.error_median_m, 4)} m, 95 % {_number(c.error_95_m, 4)} m",
    )
    add("normalised error", _normalised_error(c))
    add(
        "reference quality",
        f"median {_number(c.reference_quality_matched, 3)} matched, "
        f"{_number(c.reference_quality_missed, 3)} missed",
    )
    add(
        "detected quality",
        f"median {_number(c.detected_quality_matched, 3)} matched, "
        f"{_number(c.detected_quality_extra, 3)} extra",
    )
    return table


def _set_aside(c: Comparison) -> str:
    if not c.options.only_identified:
        return ""
    return f" (with an ID only; {c.set_aside} on rows without one set aside)"


def _normalised_error(c: Comparison) -> str:
    error = c.normalised_error
    if error.band is None:
        text = _NONE
    else:
        low, high = error.band
        text = (
            f"{_number(error.per_dof, 3)} squared per degree of freedom "
            f"(95 % band {low:.3f} to {high:.3f})"
        )
    source = {"detected": "detected", "reference": "reference", "sum": "detected plus reference"}
    text += f", covariance: {source[c.options.error_covariance]}"
    if error.left_out:
        text += f"; {error.left_out} not positive definite left out"
    return text


def _over_distance(c: Comparison) -> Table:
    table = _table("By forward distance (position error and quality: medians)")
    for heading in (
        "metres", "reference", "missed", "recall", "detected", "extra", "precision",
        "error", "ref. quality", "det. quality", "diff.",
    ):  # fmt: skip
        table.add_column(heading, justify="right")
    for part in c.bins:
        if part.reference == part.detected == 0:
            continue
        table.add_row(
            _range(part),
            str(part.reference),
            str(part.missed),
            _number(part.recall, 3),
            str(part.detected),
            str(part.extra),
            _number(part.precision, 3),
            _number(part.error_median_m, 3),
            _number(part.reference_quality_median, 3),
            _number(part.detected_quality_median, 3),
            _number(part.quality_difference, 3),
        )
    return table


def _range(part: DistanceBin) -> str:
    if part.from_m is None:
        return f"< {part.to_m:g}"
    if part.to_m is None:
        return f">= {part.from_m:g}"
    return f"{part.from_m:g}-{part.to_m:g}"


def _worst_frames(c: Comparison) -> Table:
    table = _table("Worst frames")
    table.add_column("image", overflow="fold")
    for heading in ("matched", "missed", "extra", "largest error m"):
        table.add_column(heading, justify="right")
    for frame in c.worst_frames(_WORST_FRAMES):
        table.add_row(
            Text(_printable(frame.name)),
            str(frame.matched),
            str(frame.missed),
            str(frame.extra),
            _number(frame.largest_error_m, 3),
        )
    return table


def _table(title: str) -> Table:
    return Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)


def _number(value: float | None, decimals: int) -> str:
    if value is None:
        return _NONE
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # adding 0 makes -0 a 0


def _printable(name: str) -> str:
    """A name from a file, with what a terminal would choke on or obey escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in name)
