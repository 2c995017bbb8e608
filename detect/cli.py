"""The command ``detect``.

Only what `--help` needs is imported at once; everything heavy waits for the command that uses it.

Exit codes: 0 all went well; 1 the command could not be carried out, or a demand of `compare` was
not met; 2 the command line was wrong; 3 some frames could not be worked on (the others were).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg, subcommand

from detect.compare_result import CompareOptions
from detect.line_settings import PRESETS as LINE_PRESETS
from detect.line_settings import LineSettings
from detect.settings import PUBLISHED, CircleSettings

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import Console, Group
    from rich.progress import Progress

    from camera import Camera
    from detect.circles import CircleDetections
    from detect.circles_run import FrameSink
    from detect.compare_result import Rates
    from detect.lines import LineDetections
    from detect.lines_run import LineSink
    from detect.run import RunFrame

Preset = Literal["default", "published"]

EXIT_ERROR = 1
EXIT_FRAMES_FAILED = 3

_CIRCLE_PRESETS = {"default": CircleSettings(), "published": PUBLISHED}
_SHOWN_FAILURES = 10


@dataclass(frozen=True)
class Circles:
    """Detect the discs of a run and write them to a .circles file.

    Example: detect circles images/e --draw /tmp/discs

    Parameters
    ----------
    run : Path
        Run folder of the data set's layout, or a folder of images with a .cam in it.
    preset : str
        Values that the other flags start from: `published` is the report's detector to the letter.
    camera : Path
        Calibration, if it is not the one in the run folder.
    output : Path
        The file to write; by default detected.circles in the run folder.
    tilt : Path
        Tilts of the frames (written by `detect lines`): positions are corrected for them.
    force : bool
        Replace existing files.
    draw : Path
        Folder for images with the outlines and qualities drawn in.
    json : Path
        Write the rows with their pixels and evidence as JSON as well.
    """

    run: Positional[Path]
    preset: Preset = "default"
    camera: Path | None = None
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    tilt: Path | None = None
    force: bool = False
    draw: Path | None = None
    json: Path | None = None
    settings: OmitArgPrefixes[CircleSettings] = field(default_factory=CircleSettings)


@dataclass(frozen=True)
class Lines:
    """Detect the verticals of a run and write them to a .lines file, and the tilt to a .tilt file.

    Example: detect lines images/e --join-threshold 0.006

    Parameters
    ----------
    run : Path
        Run folder of the data set's layout, or a folder of images with a .cam in it.
    preset : str
        Values that the other flags start from: `published` is the report's parameters.
    camera : Path
        Calibration, if it is not the one in the run folder.
    output : Path
        The file to write; by default detected.lines in the run folder.
    tilt : Path
        The tilt file to write; by default the output's name with the ending .tilt.
    ids_from : Path
        A .lines file whose IDs are carried over where the match is unambiguous.
    join_threshold : float
        Lines whose bearings are closer than this (radians) are joined; overrides `--join-px`.
    force : bool
        Replace existing files.
    draw : Path
        Folder for images with the lines and their standard deviations drawn in.
    rejected : bool
        Draw all tracks instead, the rejected ones with the reason.
    response : bool
        Draw the filter's response as well, into files of their own.
    """

    run: Positional[Path]
    preset: Preset = "default"
    camera: Path | None = None
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    tilt: Path | None = None
    ids_from: Path | None = None
    join_threshold: float | None = None
    force: bool = False
    draw: Path | None = None
    rejected: bool = False
    response: bool = False
    settings: OmitArgPrefixes[LineSettings] = field(default_factory=LineSettings)


@dataclass(frozen=True)
class All:
    """Detect verticals, tilt and discs of a run; the discs' positions are corrected for the tilt.

    Example: detect all images/e --circles.polarity light

    Parameters
    ----------
    run : Path
        Run folder of the data set's layout, or a folder of images with a .cam in it.
    preset : str
        Values that the other flags start from.
    camera : Path
        Calibration, if it is not the one in the run folder.
    output : Path
        Folder for detected.circles, detected.lines and detected.tilt; by default the run's.
    force : bool
        Replace existing files.
    """

    run: Positional[Path]
    preset: Preset = "default"
    camera: Path | None = None
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    force: bool = False
    circles: CircleSettings = field(default_factory=CircleSettings)
    lines: LineSettings = field(default_factory=LineSettings)


@dataclass(frozen=True)
class Compare:
    """Compare detected rows with reference rows: matched, missed, extra, errors.

    Example: detect compare images/e --min-recall 0.9, or: detect compare images/e --lines

    Parameters
    ----------
    run : Path
        Run folder.
    lines : bool
        Compare verticals instead of discs.
    reference : Path
        Reference rows; by default map.circles (map.lines) in the run folder.
    detected : Path
        Detected rows; by default detected.circles (detected.lines) in the run folder.
    tolerance_deg : float
        Bearings of the same line differ by at most this,
    sigmas : float
        or by this many standard deviations of the detected one.
    min_recall : float
        Exit with 1 if the recall is lower.
    min_precision : float
        Exit with 1 if the precision is lower.
    json : Path
        Write the result as JSON.
    force : bool
        Replace an existing JSON file.
    """

    run: Positional[Path]
    lines: bool = False
    reference: Path | None = None
    detected: Path | None = None
    tolerance_deg: float = 0.5
    sigmas: float = 2.0
    min_recall: float | None = None
    min_precision: float | None = None
    json: Path | None = None
    force: bool = False
    options: OmitArgPrefixes[CompareOptions] = field(default_factory=CompareOptions)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    preset = _preset(given)
    circles = _CIRCLE_PRESETS.get(preset, CircleSettings())
    lines = LINE_PRESETS.get(preset, LineSettings())
    command = tyro.cli(
        Annotated[
            Annotated[
                Circles,
                subcommand("circles", default=Circles(run=tyro.MISSING, settings=circles)),
            ]
            | Annotated[
                Lines,
                subcommand("lines", default=Lines(run=tyro.MISSING, settings=lines)),
            ]
            | Annotated[
                All,
                subcommand("all", default=All(run=tyro.MISSING, circles=circles, lines=lines)),
            ]
            | Annotated[Compare, subcommand("compare")],
            arg(name=""),
        ],
        prog="detect",
        description="Landmarks with covariances out of a calibrated camera's images.",
        args=given,
    )
    try:
        if isinstance(command, Circles):
            return _circles(command)
        if isinstance(command, Lines):
            return _lines(command)
        if isinstance(command, All):
            return _all(command)
        return _compare(command)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_ERROR


def _preset(arguments: list[str]) -> str:
    """The preset that a command line names: it decides the other flags' defaults."""
    for position, argument in enumerate(arguments):
        if argument == "--preset" and position + 1 < len(arguments):
            return arguments[position + 1]
        if argument.startswith("--preset="):
            return argument.partition("=")[2]
    return "default"


def _circles(command: Circles) -> int:
    from rich.console import Console

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

    console = Console(stderr=True)
    with _progress(console) as progress:
        task = progress.add_task("discs", total=len(run.frames), rate="")

        def advance() -> None:
            progress.advance(task)
            speed = progress.tasks[0].finished_speed or progress.tasks[0].speed
            progress.update(task, rate=f"{speed:.1f} images/s" if speed else "")

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
    from rich.console import Console

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

    console = Console(stderr=True)
    with _progress(console) as progress:
        task = progress.add_task("lines", total=len(run.frames), rate="")

        def advance() -> None:
            progress.advance(task)
            speed = progress.tasks[0].finished_speed or progress.tasks[0].speed
            progress.update(task, rate=f"{speed:.1f} images/s" if speed else "")

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


def _progress(console: Console) -> Progress:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}", justify="right"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )


def _print_failures(failures: list[str]) -> None:
    if not failures:
        return
    print(f"{len(failures)} frames could not be worked on:", file=sys.stderr)
    for line in failures[:_SHOWN_FAILURES]:
        print(f"  {line}", file=sys.stderr)
    if len(failures) > _SHOWN_FAILURES:
        print(f"  and {len(failures) - _SHOWN_FAILURES} more", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
