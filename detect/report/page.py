"""A report as one HTML page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from detect.comparison.circles import FLOOR_GATE_M
from detect.comparison.report import number
from detect.drawing.inputs import picture_name
from detect.line_settings import LineSettings
from detect.markers.settings import MarkerSettings
from detect.report.accuracy import disc_parts, line_parts
from detect.report.figures import counts_figure, tilt_figure
from detect.report.inputs import ReportInputs
from detect.report.parts import PAGE, STYLE, Part, Section, data_address, figure_part, scaled
from detect.settings import CircleSettings

#: An image of a frame (JPEG), its width and height; or why there is none.
Picture = tuple[bytes, int, int] | str


class Gallery(NamedTuple):
    """Cut-outs round discs that are "missed" or "extra": a JPEG, and how many of how many discs."""

    fate: str
    content: bytes
    width: int
    height: int
    shown: int
    of: int


_NAMES = {"circles": "Discs", "lines": "Verticals", "markers": "Markers", "tilt": "Tilt"}
_FATES = {"missed": "reference rows that are missing", "extra": "rows that fit no reference row"}
_SIGMA = "\N{GREEK SMALL LETTER SIGMA}"


def report_page(
    inputs: ReportInputs,
    version: str,
    worst: int,
    picture_of: Callable[[str], Picture],
    galleries: Sequence[Gallery] = (),
) -> bytes:
    """The whole page, UTF-8; the same inputs give the same bytes.

    Parameters
    ----------
    inputs : ReportInputs
    version : str
        Of the program, for the page's foot.
    worst : int
        How many of the worst frames are shown.
    picture_of : callable
        Gives the picture of a frame, by its prefix.
    galleries : sequence of Gallery
    """
    sections = [Section("summary", "What was found", _summary(inputs))]
    if "circles" in inputs.files.detected:
        sections.append(Section("discs", "Discs against the reference", disc_parts(inputs)))
        sections[-1].parts.extend(
            Part(
                "figure",
                f"{each.shown} of the {each.of} {_FATES[each.fate]}, evenly over the run; the "
                "outline is wider than the disc.",
                data_address(each.content, "jpeg"),
                each.width,
                each.height,
            )
            for each in galleries
        )
    if "lines" in inputs.files.detected:
        sections.append(Section("verticals", "Verticals against the reference", line_parts(inputs)))
    sections.append(Section("frames", *_frames(inputs, worst, picture_of)))
    if "tilt" in inputs.files.detected:
        sections.append(Section("tilt", "Tilt", _tilt(inputs)))
    sections.append(Section("timing", "Timing", _timing(inputs)))
    sections.append(Section("settings", "Effective configuration", _settings(inputs, version)))
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, finalize=_clean
    )
    page = environment.from_string(PAGE).render(
        title=f"Detections of {inputs.run.name}",
        # The page's own, with quotation marks that are no text.
        style=Markup(STYLE),
        sections=sections,
    )
    return (page.rstrip("\n") + "\n").encode("utf-8")


def _clean(value: Any) -> Any:
    """Text without characters that are not allowed in a page."""
    if type(value) is not str:
        return value
    return "".join(
        c
        if (c >= " " or c in "\n\t") and not "\ud800" <= c <= "\udfff" and c != "\x7f"
        else "\ufffd"
        for c in value
    )


# -- sections ---------------------------------------------------------------------------------


def _summary(inputs: ReportInputs) -> list[Part]:
    entries = [("frames", str(len(inputs.rows)))]
    rows = []
    for kind, path in inputs.files.detected.items():
        if kind == "tilt":
            count = sum(seen.tilt is not None for seen in inputs.rows)
            inside = [seen.tilt is not None for seen in inputs.rows]
        else:
            each = [getattr(seen, kind) for seen in inputs.rows]
            count = sum(len(found) for found in each if found is not None)
            inside = [found is not None and len(found) > 0 for found in each]
        entries.append(
            (_NAMES[kind].lower() if kind != "tilt" else "frames with a tilt", str(count))
        )
        rows.append((_NAMES[kind], path.name, str(count), str(sum(inside))))
    for name, comparison in (("discs", inputs.discs), ("verticals", inputs.lines)):
        if comparison is not None:
            entries.append((f"recall of {name}", number(comparison.recall, 3)))
            entries.append((f"precision of {name}", number(comparison.precision, 3)))
    head = ("what", "file", "rows", "frames with some")
    return [
        Part("figures", entries=tuple(entries)),
        Part("table", caption="Files of rows", head=head, rows=tuple(rows), text=(1,)),
        figure_part(counts_figure(inputs.rows), "Rows in each frame, over the run."),
    ]


def _frames(
    inputs: ReportInputs, worst: int, picture_of: Callable[[str], Picture]
) -> tuple[str, list[Part]]:
    """Heading and parts: the worst frames, or some frames if there is no reference to rank them."""
    named = {picture_name(prefix): prefix for prefix in inputs.names}
    parts: list[Part] = []
    shown: dict[str, str] = {}
    for kind, unit, scores in _worst(inputs, worst):
        head = ("frame", "matched", "missed", "extra", f"largest error / {unit}")
        caption = f"Frames with most missed and extra {kind}"
        parts.append(Part("table", caption=caption, head=head, rows=tuple(scores)))
        for rank, (name, *_) in enumerate(scores, 1):
            prefix = named.get(name, name)
            place = f"number {rank} of {kind}"
            shown[prefix] = f"{shown[prefix]}, {place}" if prefix in shown else place
    if parts:
        title = "Worst frames"
        parts.append(
            Part(
                "key",
                entries=(
                    ("#ffaa00", f"disc's edge; ±1 {_SIGMA} of a vertical"),
                    ("#3cc83c", "outlines; vertical"),
                    ("#ff3cff", "fits no reference row"),
                    ("#ff3c3c", "reference row that is missing"),
                ),
            )
        )
        parts.append(
            Part(
                "note",
                "Above a disc: quality, distance to its reference row in the image. Below a "
                "vertical: error of the bearing in standard deviations.",
            )
        )
    else:
        title = "Some frames"
        count = min(worst, len(inputs.names))
        for k in np.unique(np.linspace(0, len(inputs.names) - 1, count).astype(int)):
            shown[inputs.names[k]] = "no reference rows"
    for prefix, why in shown.items():
        words = f"Frame {picture_name(prefix)} ({why})"
        picture = picture_of(prefix)
        if isinstance(picture, str):
            parts.append(Part("note", f"{words}: {picture}"))
        else:
            content, width, height = picture
            parts.append(Part("figure", words, data_address(content, "jpeg"), width, height))
    return title, parts


def _worst(inputs: ReportInputs, count: int) -> Iterator[tuple[str, str, list[tuple[str, ...]]]]:
    """What, the unit of its errors, and a row of a table for each of the worst frames."""
    for what, unit, comparison, factor, decimals in (
        ("discs", "mm", inputs.discs, 1e3, 1),
        ("verticals", "deg", inputs.lines, 1.0, 3),
    ):
        if comparison is not None:
            yield what, unit, [
                (s.name, str(s.matched), str(s.missed), str(s.extra),
                 scaled(s.largest_error, factor, decimals))
                for s in comparison.worst_frames(count)
            ]  # fmt: skip


def _tilt(inputs: ReportInputs) -> list[Part]:
    tilts = [seen.tilt for seen in inputs.rows if seen.tilt is not None]
    if not tilts:
        return [Part("note", "No frame has a tilt: too few verticals agreed.")]
    parts = [
        figure_part(
            tilt_figure(inputs.rows),
            "Pitch and roll that turn measured directions level, with one standard deviation.",
        )
    ]
    rows = []
    for name, value, variance in (
        ("pitch", [t.pitch for t in tilts], [t.cpp for t in tilts]),
        ("roll", [t.roll for t in tilts], [t.crr for t in tilts]),
    ):
        angle = np.degrees(value)
        sigma = np.degrees(np.sqrt(variance))
        rows.append(
            (name, *(f"{figure:.3f}" for figure in
                     (angle.mean(), angle.std(), np.abs(angle).max(), np.median(sigma))))
        )  # fmt: skip
    head = ("degrees", "mean", "deviation", "largest", f"median of its {_SIGMA}")
    lines = np.median([t.lines for t in tilts])
    caption = f"{len(tilts)} of {len(inputs.rows)} frames; {lines:g} verticals agree (median)"
    return [*parts, Part("table", caption=caption, head=head, rows=tuple(rows))]


def _timing(inputs: ReportInputs) -> list[Part]:
    timing = inputs.timing
    if timing is None:
        words = "Not measured: --time-frames 20 detects 20 of the frames again and states it."
        return [Part("note", words)]
    rows = (
        ("decoding the image", f"{timing.decoding_ms:.2f}", "1.00"),
        (
            f"detecting {timing.what}",
            f"{timing.detecting_ms:.2f}",
            f"{timing.detecting_ms / timing.decoding_ms:.2f}",
        ),
    )
    caption = f"Processor time, medians of {timing.frames} frames, on the machine of this report"
    return [Part("table", caption=caption, head=("", "ms", "x decoding"), rows=rows)]


def _settings(inputs: ReportInputs, version: str) -> list[Part]:
    parts: list[Part] = []
    for kind, head in inputs.files.heads.items():
        usual = _defaults(kind)
        name = inputs.files.detected[kind].name
        parts.append(Part("heading", name))
        if head.settings:
            rows = tuple((key, value, usual.get(key, "")) for key, value in head.settings)
            caption = f"Settings in the head of {name}; bold where not the default"
            parts.append(Part("settings", caption=caption, rows=rows))
        words = [line for line in head.comments if line and not line.startswith("settings ")]
        parts += [Part("note", line) for line in words] or [Part("note", "No head in the file.")]
    gate, line_gate = inputs.gate, inputs.line_gate
    if inputs.sight is not None and not gate.on_floor:
        same = f"within half its image or {gate.least_px:g} px"
    else:
        same = f"within {FLOOR_GATE_M if gate.gate_m is None else gate.gate_m:g} m"
    parts.append(
        Part(
            "note",
            f"The same disc: {same}. The same vertical: within "
            f"{line_gate.tolerance_deg:g}° or {line_gate.sigmas:g} standard deviations. "
            f"Page written by detect report, version {version}.",
        )
    )
    return parts


def _defaults(kind: str) -> dict[str, str]:
    """The default settings, written as heads write them."""
    kinds: dict[str, Any] = {
        "circles": CircleSettings, "lines": LineSettings, "markers": MarkerSettings,
    }  # fmt: skip
    if kind not in kinds:
        return {}
    usual = kinds[kind]()
    return {f.name: str(getattr(usual, f.name)).replace(" ", "") for f in fields(usual)}
