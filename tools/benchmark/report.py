"""The result as tables for a terminal, and as Markdown. Ratios come first: they are what holds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.console import Group
from rich.table import Table
from rich.text import Text

from tools.benchmark.errors import BenchmarkError
from tools.benchmark.result import (
    KindTimes,
    Result,
    RunTimes,
    costs_per_landmark,
    growth_powers,
    times_one_job_beyond,
)
from tools.benchmark.timing import Spread

_BEGIN, _END = "<!-- benchmark begins -->", "<!-- benchmark ends -->"


def result_tables(result: Result) -> Group:
    """Everything but the growth curves' single functions, for a terminal."""
    parts: list[Table | Text] = [Text(line) for line in description_lines(result)]
    parts += [_kind_table(kind) for kind in result.kinds]
    parts += [_comparison_table(kind) for kind in result.kinds if kind.comparisons]
    parts.append(_runs_table("Whole runs, files in, files out", result.runs))
    for title, points in (
        ("Growth with the image, Mpixel", result.by_megapixels),
        ("Growth with the discs", result.by_discs),
        ("Growth with the verticals", result.by_verticals),
    ):
        table = Table(title=title, title_justify="left")
        names = [function.name for function in points[0].functions] if points else []
        table.add_column("")
        for name in names:
            table.add_column(f"{name} / ms", justify="right")
        for point in points:
            table.add_row(f"{point.amount:.3g}", *(number(t.ms.median) for t in point.functions))
        parts.append(table)
    parts += [Text(line) for line in growth_lines(result)]
    parts.append(_runs_table("Growth with the frames", result.by_frames))
    return Group(*parts)


def description_lines(result: Result) -> list[str]:
    """What it was measured on, and what was not measured."""
    machine = result.machine
    versions = ", ".join(f"{name} {version}" for name, version in machine.versions.items())
    lines = [f"{machine.cpu}, {machine.cores} cores, {machine.system}; {versions}"]
    measured = ", ".join(
        f"{key} {' '.join(map(str, value)) if isinstance(value, list | tuple) else value}"
        for key, value in result.settings.items()
    )
    lines.append(f"settings: {measured}")
    lines += [f"not installed: {name}" for name in result.absent]
    lines += [f"not measured: {sentence}" for sentence in result.skipped]
    return lines


def format_markdown(result: Result) -> str:
    """The tables that documents show: functions on all kinds of pictures, and whole runs."""
    kinds = result.kinds
    lines = [
        *(f"- {line}" for line in description_lines(result)),
        *(f"- {kind.kind}: {kind.pictures} images, {kind.description}" for kind in kinds),
        "",
        "Median processor time per image, in times that decoding the same image takes (quartiles; "
        "milliseconds):",
        "",
        *_markdown_row(["", *(kind.kind for kind in kinds)], head=True),
    ]
    for function in kinds[0].functions:
        cells = []
        for kind in kinds:
            times = next(t for t in kind.functions if t.name == function.name)
            cells.append(f"{spread(times.decodings)}; {number(times.ms.median)} ms")
        lines += _markdown_row([function.name, *cells])
    lines += [
        "",
        "How many times as long as the detector of this project a peer takes on the same image "
        "(quartiles):",
        "",
        *_markdown_row(["peer / own", *(kind.kind for kind in kinds)], head=True),
    ]
    for compared in kinds[0].comparisons:
        cells = [
            spread(next(c.ratio for c in kind.comparisons if c.slower == compared.slower))
            for kind in kinds
        ]
        lines += _markdown_row([f"{compared.slower} / {compared.faster}", *cells])
    lines += [
        "",
        "Whole runs, files in, files out, by the clock on the wall, as a share of what one core "
        "that does nothing else reaches in the same process (quartiles):",
        "",
        *_markdown_row(
            [
                "per job",
                "jobs",
                "images/s",
                "of decoding from memory",
                "of reading and decoding files",
            ],
            head=True,
        ),
    ]
    for passes in result.runs:
        lines += _markdown_row(
            [
                f"`{passes.command}`, {passes.frames} frames",
                str(passes.jobs),
                number(passes.images_per_s.median),
                spread(passes.share_of_decoding),
                spread(passes.share_of_reading),
            ]
        )
    for alone in result.runs[:1]:
        lines += _markdown_row(["*decoding from memory*", "1", _per_s(alone)[0], "1", ""])
        lines += _markdown_row(["*reading and decoding files*", "1", _per_s(alone)[1], "", "1"])
    lines += _by_frames(result.by_frames)
    lines += ["", "Growth, fitted to the medians:", "", *(f"- {t}" for t in growth_lines(result))]
    return "\n".join(lines) + "\n"


def _by_frames(runs: Sequence[RunTimes]) -> list[str]:
    """Runs of growing length by each number of jobs; how many times as many images as by one."""
    if not runs:
        return []
    jobs = sorted({times.jobs for times in runs})
    lines = [
        "",
        f"`{runs[0].command}` on runs of growing length, images/s (times those of one job); "
        "processes of their own take a second to begin:",
        "",
        *_markdown_row(["frames", *(f"jobs: {count}" for count in jobs)], head=True),
    ]
    for frames in sorted({times.frames for times in runs}):
        cells = []
        for times in sorted((t for t in runs if t.frames == frames), key=lambda t: t.jobs):
            cell = number(times.images_per_s.median)
            if times.jobs > 1 and times.times_one_job is not None:
                cell += f" ({number(times.times_one_job.median)})"
            cells.append(cell)
        lines += _markdown_row([str(frames), *cells])
    for count in jobs:
        beyond = times_one_job_beyond(runs, count) if count > 1 else None
        if beyond is not None:
            lines += [
                "",
                f"Beyond the first {beyond[0]} frames {count} jobs do {number(beyond[1])} times as "
                "many.",
            ]
    return lines


def format_headline(result: Result) -> str:
    """The medians alone, as one short Markdown table and a line on whole runs."""
    kinds = result.kinds
    lines = _markdown_row(["x decoding (ms)", *(kind.kind for kind in kinds)], head=True)
    for row in zip(*(kind.functions for kind in kinds)):
        cells = [f"{number(t.decodings.median)} ({number(t.ms.median)})" for t in row]
        lines += _markdown_row([row[0].name, *cells])
    passes = "; ".join(
        f"`{t.command}` {number(t.images_per_s.median)} images/s, "
        f"{number(t.share_of_decoding.median)} of decoding from memory, "
        f"{number(t.share_of_reading.median)} of reading and decoding files"
        for t in result.runs
    )
    for alone in result.runs[:1]:
        decoding, reading = _per_s(alone)
        passes += (
            f" ({alone.frames} frames; decoding alone {decoding} images/s, with reading {reading})"
        )
    longest = max((times.frames for times in result.by_frames), default=0)
    for times in result.by_frames:
        if times.frames == longest and times.jobs > 1 and times.times_one_job is not None:
            passes += (
                f"; `{times.command}` of {times.frames} frames with {times.jobs} jobs "
                f"{number(times.images_per_s.median)} images/s, "
                f"{number(times.times_one_job.median)} times one job"
            )
            beyond = times_one_job_beyond(result.by_frames, times.jobs)
            if beyond is not None:
                passes += f" ({number(beyond[1])} beyond the first {beyond[0]})"
    pictures, rounds = (result.settings[key] for key in ("pictures", "rounds"))
    machine = result.machine
    return "\n".join(
        [
            *lines,
            "",
            f"Whole runs, files in, files out, one job each: {passes}. {machine.cpu}; {pictures} "
            f"pictures of each kind, {rounds} rounds.",
            "",
        ]
    )


def spliced(document: str, part: str) -> str:
    """A document with another part between its marks.

    Parameters
    ----------
    document : str
        Text that has the two marks on lines of their own.
    part : str
        What comes between them.

    Returns
    -------
    str

    Raises
    ------
    BenchmarkError
        If it has not exactly one of each, in their order.
    """
    before, begin, rest = document.partition(_BEGIN)
    _, end, after = rest.partition(_END)
    if not begin or not end or _BEGIN in rest or _END in before + after:
        raise BenchmarkError(f"the document has no place for the table: expected {_BEGIN} {_END}")
    return f"{before}{_BEGIN}\n{part}{_END}{after}"


def growth_lines(result: Result) -> list[str]:
    """How times grow, in a sentence for each function that has a curve."""
    lines = []
    if len(result.by_megapixels) > 1:
        for name, power in growth_powers(result.by_megapixels).items():
            lines.append(f"{name}: time grows as the number of pixels to the power {power:.2f}")
    for points, landmark in ((result.by_discs, "disc"), (result.by_verticals, "vertical")):
        if len(points) > 1:
            for name, (bare, each) in costs_per_landmark(points).items():
                lines.append(f"{name}: {bare:.2f} ms, and {each:.3f} ms for each {landmark}")
    return lines


def number(value: float) -> str:
    """A positive number in two or three digits, without an exponent."""
    for least, digits in ((99.95, 0), (9.995, 1), (0.0995, 2), (0.00995, 3)):
        if value >= least:
            return f"{value:,.{digits}f}"
    return f"{value:.4f}"


def spread(values: Spread) -> str:
    """Median and quartiles."""
    return f"{number(values.median)} ({_quartiles(values)})"


def _per_s(passes: RunTimes) -> tuple[str, str]:
    """Images per second of decoding from memory, and of reading and decoding."""
    spreads = passes.decoding_images_per_s, passes.reading_images_per_s
    from_memory, from_files = (number(values.median) for values in spreads)
    return from_memory, from_files


def _kind_table(kind: KindTimes) -> Table:
    table = Table(
        title=f"{kind.kind}: {kind.pictures} images, {kind.description}", title_justify="left"
    )
    table.add_column("function", no_wrap=True)
    for column in ("x decoding", "quartiles", "ms/image", "quartiles", "calls"):
        table.add_column(column, justify="right")
    group = kind.functions[0].group
    for times in kind.functions:
        if times.group != group:
            table.add_section()
            group = times.group
        table.add_row(
            times.name,
            number(times.decodings.median),
            _quartiles(times.decodings),
            number(times.ms.median),
            _quartiles(times.ms),
            str(times.ms.count),
        )
    return table


def _comparison_table(kind: KindTimes) -> Table:
    table = Table(title=f"{kind.kind}: peers", title_justify="left")
    table.add_column("time of peer / own")
    table.add_column("ratio", justify="right")
    table.add_column("quartiles", justify="right")
    for compared in kind.comparisons:
        table.add_row(
            f"{compared.slower} / {compared.faster}",
            number(compared.ratio.median),
            _quartiles(compared.ratio),
        )
    return table


def _runs_table(title: str, runs: Iterable[RunTimes]) -> Table:
    table = Table(
        title=title,
        title_justify="left",
        caption="* images per second and job / those of decoding the same files from memory, or of "
        "reading and decoding them, and nothing else; in brackets those",
        caption_justify="left",
    )
    table.add_column("command", no_wrap=True)
    for column in (
        "of decoding*",
        "quartiles",
        "of reading*",
        "quartiles",
        "images/s",
        "frames",
        "jobs",
        "of one job",
    ):
        table.add_column(column, justify="right")
    for times in runs:
        decoding, reading = _per_s(times)
        table.add_row(
            times.command,
            f"{number(times.share_of_decoding.median)} ({decoding}/s)",
            _quartiles(times.share_of_decoding),
            f"{number(times.share_of_reading.median)} ({reading}/s)",
            _quartiles(times.share_of_reading),
            number(times.images_per_s.median),
            str(times.frames),
            str(times.jobs),
            "" if times.times_one_job is None else number(times.times_one_job.median),
        )
    return table


def _quartiles(values: Spread) -> str:
    return f"{number(values.lower_quartile)} - {number(values.upper_quartile)}"


def _markdown_row(cells: list[str], *, head: bool = False) -> list[str]:
    row = f"| {' | '.join(cells)} |"
    return [row, f"|{'---|' * len(cells)}"] if head else [row]
