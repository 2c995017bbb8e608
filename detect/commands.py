"""What the commands of ``detect`` do: files, progress and messages round the detectors.

Each command imports what it needs when it runs: comparing files takes no compiler.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from detect.cli import EXIT_ERROR, EXIT_FRAMES_FAILED, All, Circles, Compare, Lines

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import Group

    from camera import Camera
    from detect.circles import CircleDetections
    from detect.circles_run import FrameSink
    from detect.compare_result import Rates
    from detect.lines import LineDetections
    from detect.lines_run import LineSink
    from detect.run import RunFrame
    from detect.settings import CircleSettings

_SHOWN_FAILURES = 10


def carry_out(command: Circles | Lines | All | Compare) -> int:
    """Carry out a command; returns the exit code."""
    if isinstance(command, Circles):
        return _circles(command)
    if isinstance(command, Lines):
        return _lines(command)
    if isinstance(command, All):
        return _all(command)
    return _compare(command)


def _circles(command: Circles) -> int:
    from detect import __version__
    from detect.circles_run import detect_circles_run
    from detect.run import open_run
    from landmarks import read_tilts
    from storage import OutputExistsError

    run = open_run(command.run, command.camera)
    output = command.output if command.output is not None else command.run / "detected.circles"
    for path in (output, command.json):
        if path is not None and path.exists() and not command.force:
            raise OutputExistsError(path)
    draw: FrameSink | None = None
    if command.draw is not None:
        draw = _drawing_sink(command.draw, run.camera, command.settings, command.force)

    with _progress("discs", len(run.frames)) as advance:
        summary = detect_circles_run(
            run,
            command.settings,
            output,
            version=__version__,
            overwrite=command.force,
            json_output=command.json,
            tilts=None if command.tilt is None else read_tilts(command.tilt),
            on_frame=draw,
            on_progress=advance,
        )
    print(f"{output}: {summary.discs} discs in {summary.frames} frames")
    if summary.images_without_step:
        print(f"{summary.images_without_step} images are not named by a STEP row: left out")
    _print_failures(summary.failures)
    return EXIT_FRAMES_FAILED if summary.failures else 0


def _lines(command: Lines) -> int:
    from detect import __version__
    from detect.compare_pairing import image_name
    from detect.lines_run import detect_lines_run
    from detect.run import open_run
    from landmarks import read_frames
    from storage import OutputExistsError

    run = open_run(command.run, command.camera)
    output = command.output if command.output is not None else command.run / "detected.lines"
    tilt = command.tilt if command.tilt is not None else output.with_suffix(".tilt")
    for path in (output, tilt):
        if path.exists() and not command.force:
            raise OutputExistsError(path)
    settings = command.settings
    if command.join_threshold is not None:
        # On the horizon straight ahead, a bearing of one radian is scale_x pixels wide.
        settings = replace(settings, join_px=command.join_threshold * run.camera.scale_x)
    reference = None
    if command.ids_from is not None:
        by_name = {image_name(f.step.prefix): f.lines for f in read_frames(command.ids_from)}
        reference = {
            frame.step.prefix: by_name.get(image_name(frame.step.prefix), ())
            for frame in run.frames
        }
    draw = None
    if command.draw is not None:
        draw = _line_drawing_sink(command, command.draw, run.camera)

    with _progress("lines", len(run.frames)) as advance:
        summary = detect_lines_run(
            run,
            settings,
            output,
            tilt,
            version=__version__,
            overwrite=command.force,
            reference=reference,
            on_frame=draw,
            on_progress=advance,
        )
    print(f"{output}: {summary.lines} lines in {summary.frames} frames")
    print(f"{tilt}: the tilt of {summary.tilts} frames")
    if summary.images_without_step:
        print(f"{summary.images_without_step} images are not named by a STEP row: left out")
    _print_failures(summary.failures)
    return EXIT_FRAMES_FAILED if summary.failures else 0


def _all(command: All) -> int:
    folder = command.output if command.output is not None else command.run
    tilt = folder / "detected.tilt"
    lines = Lines(
        run=command.run,
        camera=command.camera,
        output=folder / "detected.lines",
        tilt=tilt,
        force=command.force,
        settings=command.lines,
    )
    circles = Circles(
        run=command.run,
        camera=command.camera,
        output=folder / "detected.circles",
        tilt=tilt,
        force=command.force,
        settings=command.circles,
    )
    return max(_lines(lines), _circles(circles))


def _line_drawing_sink(command: Lines, folder: Path, camera: Camera) -> LineSink:
    """What draws each frame's lines into PNGs."""
    import cv2

    from detect.line_drawing import draw_lines, draw_response, draw_tracks
    from lut import cached_vertical_table
    from storage import write_whole

    folder.mkdir(parents=True, exist_ok=True)
    table = cached_vertical_table(camera)

    def draw(frame: RunFrame, image: NDArray[np.uint8], found: LineDetections) -> None:
        if command.rejected:
            pictures = {"": draw_tracks(image, table, found, rejected=True, reasons=True)}
        else:
            pictures = {"": draw_lines(image, camera, table, found)}
        if command.response:
            pictures[".response"] = draw_response(found.response, table)
        for kind, picture in pictures.items():
            _, encoded = cv2.imencode(".png", picture)
            name = f"{Path(frame.step.prefix).name}{kind}.png"
            with write_whole(folder / name, overwrite=command.force) as stream:
                stream.write(encoded.tobytes())

    return draw


def _drawing_sink(
    folder: Path, camera: Camera, settings: CircleSettings, overwrite: bool
) -> FrameSink:
    """What draws each frame's detections into a PNG."""
    import cv2

    from detect.drawing import draw_circles
    from storage import write_whole

    folder.mkdir(parents=True, exist_ok=True)

    def draw(frame: RunFrame, image: NDArray[np.uint8], found: CircleDetections) -> None:
        picture = draw_circles(image, camera, found, settings)
        _, encoded = cv2.imencode(".png", picture)
        name = f"{Path(frame.step.prefix).name}.png"
        with write_whole(folder / name, overwrite=overwrite) as stream:
            stream.write(encoded.tobytes())

    return draw


def _compare(command: Compare) -> int:
    from rich.console import Console

    from detect.compare_result import unmet_demands
    from storage import write_whole

    tables, text, result = _compared_lines(command) if command.lines else _compared_discs(command)
    Console().print(tables)
    if command.json is not None:
        with write_whole(command.json, overwrite=command.force) as stream:
            stream.write(text.encode())
    unmet = unmet_demands(
        result, min_recall=command.min_recall, min_precision=command.min_precision
    )
    for sentence in unmet:
        print(sentence, file=sys.stderr)
    return EXIT_ERROR if unmet else 0


def _compared_discs(command: Compare) -> tuple[Group, str, Rates]:
    """The tables, the JSON and the result of a comparison of discs."""
    from detect.compare import compare_runs
    from detect.compare_report import comparison_tables, format_json

    result = compare_runs(
        command.run,
        reference=command.reference,
        detected=command.detected,
        options=command.options,
    )
    return comparison_tables(result), format_json(result), result


def _compared_lines(command: Compare) -> tuple[Group, str, Rates]:
    """The tables, the JSON and the result of a comparison of verticals."""
    from detect.compare_lines import compare_line_runs
    from detect.compare_lines_report import format_line_json, line_comparison_tables
    from detect.compare_lines_result import LineCompareOptions

    options = LineCompareOptions(
        tolerance_deg=command.tolerance_deg,
        sigmas=command.sigmas,
        only_identified=command.options.only_identified,
        all_frames=command.options.all_frames,
    )
    result = compare_line_runs(
        command.run, reference=command.reference, detected=command.detected, options=options
    )
    return line_comparison_tables(result), format_line_json(result), result


@contextmanager
def _progress(label: str, total: int) -> Iterator[Callable[[], None]]:
    """A progress bar with the rate, on a terminal; yields what to call after every frame."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}", justify="right"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )
    with progress:
        task = progress.add_task(label, total=total, rate="")

        def advance() -> None:
            progress.advance(task)
            speed = progress.tasks[0].finished_speed or progress.tasks[0].speed
            progress.update(task, rate=f"{speed:.1f} images/s" if speed else "")

        yield advance


def _print_failures(failures: list[str]) -> None:
    if not failures:
        return
    print(f"{len(failures)} frames could not be worked on:", file=sys.stderr)
    for line in failures[:_SHOWN_FAILURES]:
        print(f"  {line}", file=sys.stderr)
    if len(failures) > _SHOWN_FAILURES:
        print(f"  and {len(failures) - _SHOWN_FAILURES} more", file=sys.stderr)
