"""What the commands of ``detect`` do: files, progress and messages round the detectors.

Each command imports what it needs when it runs: comparing files takes no compiler.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from detect.announcing import show_announcements
from detect.cli import Command
from detect.errors import EXIT_FRAMES_FAILED, DetectError, WorkerError
from detect.options import (
    All,
    Circles,
    Compare,
    DetectorFlags,
    DiscIdOptions,
    Lines,
    Markers,
)
from detect.runs.progress import print_failures, progress_bar
from detect.viewing_options import PERFORMED_BY
from storage.exit_codes import EXIT_ERROR
from storage.kernel_loading import load_kernels_alone

if TYPE_CHECKING:
    from rich.console import Group

    from detect.comparison.circles import Sight
    from detect.comparison.result import Rates
    from detect.run import ImageRun, Run
    from detect.run_tilt import RunTilt
    from detect.runs.circles_run import DiscIds
    from detect.runs.conduct import Conduct
    from detect.runs.dispatch import Workers
    from detect.runs.stream import RunSummary
    from detect.settings import CircleSettings


def carry_out(command: Command) -> int:
    """Carry out a command; returns the exit code."""
    show_announcements()
    if isinstance(command, Circles):
        return _circles(command)
    if isinstance(command, Lines):
        return _lines(command)
    if isinstance(command, Markers):
        return _markers(command)
    if isinstance(command, All):
        return _all(command)
    if isinstance(command, Compare):
        return _compare(command)
    return int(import_module(PERFORMED_BY[type(command)]).perform(command))


def _circles(command: Circles) -> int:
    from detect import __version__
    from detect.runs.circles_run import detect_circles_run
    from detect.runs.run_log import log_place
    from detect.sources.opening import open_calibrated

    run = open_calibrated(command.run, command.camera, command.source)
    output = _output(command, run, "circles")
    conduct = _conduct(command, log_place(output))
    _demand_new([output, command.json], command.force, run, conduct)
    tilts = None
    if command.tilt is not None:
        from detect.runs.by_image import TiltsByImage

        tilts = TiltsByImage(command.tilt)
    ids = _disc_ids(command.ids)
    if command.draw is not None:
        _make_folder(command.draw)
    with progress_bar("discs", run.frames.expected) as advance:
        summary = detect_circles_run(
            run,
            command.settings,
            output,
            version=__version__,
            overwrite=command.force,
            json_output=command.json,
            tilts=tilts,
            ids=ids,
            crlf=command.line_ends == "crlf",
            pictures=command.draw,
            workers=_workers(command, run),
            on_progress=advance,
            conduct=conduct,
        )
    print(f"{output}: {summary.discs} discs in {summary.frames} frames")
    return _exit_code(summary, run)


def _disc_ids(options: DiscIdOptions) -> DiscIds:
    """Where the IDs of discs come from."""
    from detect.drawing.head import read_head
    from detect.runs.by_image import DiscsByImage, MapByImage
    from detect.runs.circles_run import DiscIds

    if (options.ids_from_map is None) != (options.path is None):
        raise DetectError("--ids-from-map and --path: expected both or neither")
    rows = mapped = None
    level = False
    if options.ids_from is not None:
        rows = DiscsByImage(options.ids_from)
        level = read_head(options.ids_from).level
    if options.ids_from_map is not None and options.path is not None:
        mapped = MapByImage(options.ids_from_map, options.path)
    return DiscIds(rows, level, mapped, options.id_slack_m)


def _lines(command: Lines) -> int:
    from detect import __version__
    from detect.runs.by_image import LinesByImage
    from detect.runs.lines_run import detect_lines_run
    from detect.runs.run_log import log_place
    from detect.sources.opening import open_calibrated

    run = open_calibrated(command.run, command.camera, command.source)
    output = _output(command, run, "lines")
    tilt = command.tilt if command.tilt is not None else output.with_suffix(".tilt")
    conduct = _conduct(command, log_place(output))
    _demand_new([output, tilt], command.force, run, conduct)
    settings = command.settings
    if command.join_threshold is not None:
        # On the horizon straight ahead, a bearing of one radian is scale_x pixels wide.
        settings = replace(settings, join_px=command.join_threshold * run.camera.scale_x)
    reference = None
    if command.ids_from is not None:
        reference = LinesByImage(command.ids_from)
    if command.draw is not None:
        _make_folder(command.draw)
    with progress_bar("lines", run.frames.expected) as advance:
        summary = detect_lines_run(
            run,
            settings,
            output,
            tilt,
            version=__version__,
            overwrite=command.force,
            reference=reference,
            pictures=command.draw,
            drawing="tracks" if command.rejected else "lines",
            draw_response=command.response,
            crlf=command.line_ends == "crlf",
            workers=_workers(command, run),
            on_progress=advance,
            conduct=conduct,
        )
    print(f"{output}: {summary.lines} lines in {summary.frames} frames")
    print(f"{tilt}: the tilt of {summary.tilts} frames")
    _tell_blind_to_verticals(summary, run)
    return _exit_code(summary, run)


def _markers(command: Markers) -> int:
    from detect import __version__
    from detect.runs.markers_run import detect_markers_run
    from detect.runs.run_log import log_place
    from detect.sources.opening import open_source

    run = open_source(command.run, command.camera, command.source)
    output = _output(command, run, "markers")
    conduct = _conduct(command, log_place(output))
    _demand_new([output], command.force, run, conduct)
    if command.draw is not None:
        _make_folder(command.draw)
    with progress_bar("markers", run.frames.expected) as advance:
        summary = detect_markers_run(
            run,
            command.settings,
            output,
            version=__version__,
            overwrite=command.force,
            pictures=command.draw,
            workers=_workers(command, run),
            on_progress=advance,
            conduct=conduct,
        )
    print(f"{output}: {summary.markers} markers in {summary.frames} frames")
    if summary.rejected:
        causes = ", ".join(f"{cause} {count}" for cause, count in sorted(summary.rejected.items()))
        print(f"rejected: {causes}")
    return _exit_code(summary, run)


def _all(command: All) -> int:
    from detect import __version__
    from detect.runs.all_run import detect_all_run, frames_tilt_place
    from detect.runs.run_log import log_place
    from detect.sources.opening import open_calibrated

    run = open_calibrated(command.run, command.camera, command.source)
    lines, tilt, circles = (
        run.output(kind) if command.output is None else command.output / f"detected.{kind}"
        for kind in ("lines", "tilt", "circles")
    )
    if command.output is not None:
        _make_folder(command.output)
    conduct = _conduct(command, log_place(lines.with_suffix("")))
    frames_tilt = frames_tilt_place(tilt) if command.tilt == "run" else None
    _demand_new([lines, tilt, circles, frames_tilt], command.force, run, conduct)
    leans: list[RunTilt] = []
    disc_ids = _disc_ids(command.ids)
    line_ids = None
    if command.line_ids_from is not None:
        from detect.runs.by_image import LinesByImage

        line_ids = LinesByImage(command.line_ids_from)
    with progress_bar("lines, tilt and discs", run.frames.expected) as advance:
        summary = detect_all_run(
            run,
            command.lines,
            command.circles,
            lines,
            tilt,
            circles,
            version=__version__,
            overwrite=command.force,
            workers=_workers(command, run),
            on_progress=advance,
            conduct=conduct,
            disc_ids=disc_ids,
            line_ids=line_ids,
            crlf=command.line_ends == "crlf",
            levelling=command.tilt,
            on_lean=leans.append,
        )
    print(f"{lines}: {summary.lines} lines in {summary.frames} frames")
    if leans:
        print(f"{frames_tilt}: the tilt of {summary.tilts} frames, each by itself")
        print(f"{tilt}: {leans[0].sentence()}")
    else:
        others = _other_frames(summary, command.circles) if command.tilt != "none" else ""
        print(f"{tilt}: the tilt of {summary.tilts} frames{others}")
    print(f"{circles}: {summary.discs} discs in {summary.frames} frames")
    _tell_blind_to_verticals(summary, run)
    return _exit_code(summary, run)


def _other_frames(summary: RunSummary, settings: CircleSettings) -> str:
    """What is done with the discs of frames that have no tilt, if there are any."""
    others = summary.frames - summary.failed - summary.tilts
    if others == 0:
        return ""
    if settings.tilt_sigma_deg == 0.0:
        return f"; the other {others} count as level beyond doubt (see --circles.tilt-sigma-deg)"
    return f"; the other {others} count as level within {settings.tilt_sigma_deg:g} degrees"


def _tell_blind_to_verticals(summary: RunSummary, run: Run) -> None:
    """Say so where there are no lines for no line can be seen."""
    if summary.lines:
        return
    from lut import cached_vertical_table

    if not cached_vertical_table(run.camera).usable.any():
        print(
            "no verticals: as it is calibrated, the camera looks too far past the horizon, or lies "
            "on its side",
            file=sys.stderr,
        )


def _output(command: DetectorFlags, run: ImageRun, kind: str) -> Path:
    """The file that a command's result is written to."""
    output = command.output if command.output is not None else run.output(kind)
    if not output.name:  # what an empty word becomes, too
        raise DetectError(f"{output}: is a folder: expected the file to write")
    return output


def _make_folder(folder: Path) -> None:
    """A folder for results, if there is none yet."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise DetectError(
            f"{folder}: is no folder: expected one, or the name of a new one"
        ) from None


def _workers(command: DetectorFlags, run: ImageRun) -> Workers:
    """Who does the work of a command."""
    from detect.run import Run
    from detect.runs.workers import cluster_workers, default_jobs, local_workers, pixels_of

    # Tasks that carry images, or bring pictures back, are kept small.
    draws = isinstance(command, Circles | Lines | Markers) and command.draw is not None
    large = draws or run.frames.ships_images
    if command.cluster is not None:
        if command.jobs is not None:
            raise WorkerError("--jobs and --cluster: expected one of them")
        workers = cluster_workers(command.cluster, pictures=large)
    else:
        expected = run.frames.expected
        jobs = command.jobs if command.jobs is not None else default_jobs(expected or 0)
        pixels = pixels_of(run.camera if isinstance(run, Run) else None)
        workers = local_workers(jobs, pictures=large, frame_pixels=pixels, frames=expected)
    if not workers.tell_of_tables:  # this process makes the tables, at least
        load_kernels_alone()
    return workers


def _conduct(command: DetectorFlags, log: Path) -> Conduct:
    """How a command is carried out."""
    from detect import __version__
    from detect.runs.conduct import conduct_of

    return conduct_of(command.conduct, log, type(command).__name__.lower(), __version__)


def _demand_new(
    outputs: Sequence[Path | None], force: bool, run: ImageRun, conduct: Conduct
) -> None:
    """Refuse what cannot be written, or would be overwritten, before there is any work done."""
    from detect.runs.resume_journal import journal_place
    from detect.runs.stream import times_file
    from storage import OutputExistsError

    for path in outputs:
        if path is not None and not path.parent.is_dir():
            raise DetectError(
                f"{path}: no such folder: {path.parent}: make it first, or name another file"
            )
    if conduct.log is not None and journal_place(conduct.log).exists():
        return  # the results may be half of those of a run that was killed: told when that is over
    if run.has_times:
        outputs = [*outputs, times_file([path for path in outputs if path is not None]).path]
    for path in outputs:
        if path is not None and path.exists() and not force:
            raise OutputExistsError(path)


def _exit_code(summary: RunSummary, run: ImageRun) -> int:
    """Tell what is wrong with a run; returns the exit code."""
    if summary.images_without_step:
        print(f"{summary.images_without_step} {run.frames.why_left_out}")
    print_failures(summary.failed, summary.failures)
    return EXIT_FRAMES_FAILED if summary.failed else 0


def _compare(command: Compare) -> int:
    from rich.console import Console

    from detect.comparison.result import unmet_demands
    from storage import write_whole

    _demand_rows(command)
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


def _demand_rows(command: Compare) -> None:
    """Refuse to compare what is not there, and say where it comes from."""
    kind = "lines" if command.lines else "circles"
    reference = command.reference or command.run / f"map.{kind}"
    detected = command.detected or command.run / f"detected.{kind}"
    if not reference.exists():
        raise DetectError(
            f"{reference}: no such landmark file: name the reference rows by --reference"
        )
    if not detected.exists():
        raise DetectError(
            f"{detected}: no such landmark file: `detect {kind}` writes it, --detected names "
            "another"
        )


def _compared_discs(command: Compare) -> tuple[Group, str, Rates]:
    """The tables, the JSON and the result of a comparison of discs."""
    from detect.comparison.circles import compare_runs
    from detect.comparison.report import comparison_tables, format_json

    sight = _sight(command)
    if sight is None and not command.options.on_floor:
        print("no calibration: positions are compared on the floor; --camera names one")
    result = compare_runs(
        command.run,
        reference=command.reference,
        detected=command.detected,
        options=command.options,
        sight=sight,
    )
    return comparison_tables(result), format_json(result), result


def _sight(command: Compare) -> Sight | None:
    """How rows come back into the images; None without a calibration."""
    from camera import read_camera
    from detect.comparison.circles import Sight
    from detect.drawing.head import read_head
    from detect.run import camera_in

    camera = camera_in(command.run) if command.camera is None else read_camera(command.camera)
    if camera is None:
        return None
    reference = read_head(command.reference or command.run / "map.circles")
    detected = read_head(command.detected or command.run / "detected.circles")
    return Sight(camera, detected.circle_settings.radius_m, reference.level)


def _compared_lines(command: Compare) -> tuple[Group, str, Rates]:
    """The tables, the JSON and the result of a comparison of verticals."""
    from detect.comparison.lines import compare_line_runs
    from detect.comparison.lines_report import format_line_json, line_comparison_tables
    from detect.comparison.lines_result import LineCompareOptions

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
