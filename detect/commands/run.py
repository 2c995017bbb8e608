"""The commands ``detect circles``, ``lines``, ``markers`` and ``all``: a run in, files out."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

from detect.errors import DetectError, WorkerError
from detect.options import All, Circles, DetectorFlags, DiscIdOptions, Lines, Markers
from detect.row_files import KINDS, RunRows
from detect.runs.hints import hints, some_images
from detect.runs.outputs import depth_sentence, frames_tilt_place, lean_sentence
from detect.runs.plan import (
    FramePlan,
    FramesByImage,
    Job,
    MapByImage,
    Priors,
    RunSummary,
    tilts_by_image,
)
from detect.runs.stream import detect_run
from detect.runs.workers import Workers, cluster_workers, default_jobs, local_workers
from detect.settings import CircleSettings
from detect.sources.image_files import demand_pictures
from detect.sources.interface import ImageRun, Run
from detect.sources.opening import demand_recording, open_run, open_source
from detect.terminal import progress_bar, report_failures
from redetect.landmarks.files import read_head
from redetect.messages import counted


def perform(command: DetectorFlags) -> int:
    """Carry a command out; returns the exit code."""
    pictures, rejected = getattr(command, "draw", None), getattr(command, "rejected", False)
    if rejected and pictures is None:
        raise DetectError("--rejected: expected a folder for pictures beside it: --draw FOLDER")
    job = replace(
        _job_of(command),
        command=type(command).__name__.lower(),
        crlf=command.line_ends == "crlf",
        overwrite=command.force,
        strict=command.strict,
        resume=command.resume,
    )
    workers = _workers(command, job)
    if pictures is not None:
        demand_recording(command.run)
        demand_pictures(job.run.frames, pictures, overwrite=command.force)
    with progress_bar(", ".join(job.outputs), job.run.frames.expected) as advance:
        summary = detect_run(job, workers, advance)
    if pictures is not None:
        from detect.commands.draw import draw_run  # loads the detectors

        files = {kind: path for kind, path in job.outputs.items() if kind in KINDS}
        plan = job.plan if rejected else None
        draw_run(job.run, RunRows(files), pictures, plan, overwrite=command.force)
    _print_results(job, summary)
    for hint in hints(job, summary):
        print(hint, file=sys.stderr)
    if summary.images_left_out:
        print(f"{summary.images_left_out} {job.run.frames.why_left_out}")
    return report_failures(summary.failed, summary.failures)


def _job_of(command: DetectorFlags) -> Job:
    if isinstance(command, Markers):
        return _markers(command)
    run = open_run(command.run, command.camera, command.source)
    if isinstance(command, Circles):
        return _circles(command, run)
    if isinstance(command, Lines):
        return _lines(command, run)
    assert isinstance(command, All)
    return _all(command, run)


def _circles(command: Circles, run: Run) -> Job:
    outputs = {"circles": _output(command, run, "circles")}
    if command.json is not None:
        outputs["json"] = command.json
    settings = _with_radius(command.detector, run) if command.find_radius else command.detector
    bare = command.tilt == Path("none")
    plan = FramePlan(run.camera, circles=settings, levelling="none" if bare else "frame")
    tilts = None if bare or command.tilt is None else tilts_by_image(command.tilt)
    return Job(run, plan, outputs, replace(_known_discs(command.ids), tilts=tilts))


def _lines(command: Lines, run: Run) -> Job:
    output = _output(command, run, "lines")
    plan = FramePlan(run.camera, lines=command.detector)
    outputs = {"lines": output, "tilt": command.tilt_output or output.with_suffix(".tilt")}
    return Job(run, plan, outputs, Priors(lines=_frames(command.ids_from)))


def _markers(command: Markers) -> Job:
    run = open_source(command.run, command.camera, command.source)
    plan = FramePlan(run.camera if isinstance(run, Run) else None, markers=command.detector)
    return Job(run, plan, {"markers": _output(command, run, "markers")})


def _all(command: All, run: Run) -> Job:
    if command.output is not None:
        command.output.mkdir(parents=True, exist_ok=True)
    outputs = {
        kind: run.output(kind) if command.output is None else command.output / f"detected.{kind}"
        for kind in ("lines", "tilt", "circles")
    }
    circles = _with_radius(command.circles, run) if command.find_radius else command.circles
    return Job(
        run,
        FramePlan(run.camera, lines=command.lines, circles=circles, levelling=command.tilt),
        outputs,
        replace(_known_discs(command.ids), lines=_frames(command.line_ids_from)),
        base=outputs["lines"].with_suffix(""),
    )


def _with_radius(settings: CircleSettings, run: Run) -> CircleSettings:
    """The settings with the radius estimated from some of the images."""
    from detect.lean import leaning_as
    from detect.radius import LARGEST_M, SMALLEST_M, find_radius

    images = list(some_images(run))
    found = find_radius(images, leaning_as(images, run.camera), settings)
    if found is None:
        raise DetectError(
            f"{len(images)} images: the radius of the discs cannot be estimated from them: "
            f"expected some of {SMALLEST_M:g} to {LARGEST_M:g} m on the floor, or --radius-m"
        )
    print(
        f"discs have a radius of {found.radius_m:.4f} +- {found.sigma_m:.4f} m, estimated from "
        f"{found.discs} of them in {len(images)} images",
        file=sys.stderr,
    )
    return replace(settings, radius_m=round(found.radius_m, 4))


def _output(command: DetectorFlags, run: ImageRun, kind: str) -> Path:
    """The file for a command's result."""
    output = command.output if command.output is not None else run.output(kind)
    if not output.name:  # what an empty word becomes, too
        raise DetectError(f"{output}: is a folder: expected an output file")
    return output


def _frames(path: Path | None) -> FramesByImage | None:
    return None if path is None else FramesByImage(path)


def _known_discs(options: DiscIdOptions) -> Priors:
    """Discs with IDs from files."""
    if (options.ids_from_map is None) != (options.path is None):
        raise DetectError("--ids-from-map and --path: expected both or neither")
    mapped = None
    if options.ids_from_map is not None and options.path is not None:
        mapped = MapByImage(options.ids_from_map, options.path)
    level = options.ids_from is not None and read_head(options.ids_from).level
    return Priors(discs=_frames(options.ids_from), discs_level=level, mapped=mapped)


def _workers(command: DetectorFlags, job: Job) -> Workers:
    """The workers of a command."""
    frames = job.run.frames
    if command.cluster is not None:
        if command.jobs is not None:
            raise WorkerError("--jobs and --cluster: expected one of them")
        return cluster_workers(command.cluster, large=frames.images_in_memory)
    jobs = command.jobs if command.jobs is not None else default_jobs(frames.expected or 0)
    return local_workers(jobs, large=frames.images_in_memory, shared=True)


def _print_results(job: Job, summary: RunSummary) -> None:
    found, outputs, tilt = summary.found, job.outputs, summary.tilt
    camera, circles = job.plan.camera, job.plan.circles
    frames = counted(summary.frames, "frame")
    if "lines" in outputs:
        print(f"{outputs['lines']}: {counted(found['lines'], 'line')} in {frames}")
    if "tilt" in outputs and tilt is not None:
        place = frames_tilt_place(outputs["tilt"])
        print(f"{place}: the separate tilts of {counted(found['tilts'], 'frame')}")
        height_m = float(camera.centre[2]) if camera and "circles" in outputs else 0.0
        print(f"{outputs['tilt']}: {tilt.sentence(height_m)}")
    elif "tilt" in outputs:
        others = _other_frames(job.plan, summary)
        print(f"{outputs['tilt']}: the tilt of {counted(found['tilts'], 'frame')}{others}")
    for kind, what in (("circles", "disc"), ("markers", "marker")):
        if kind in outputs:
            print(f"{outputs[kind]}: {counted(found[f'{what}s'], what)} in {frames}")
    if job.run.bit_depth is not None:
        print(depth_sentence(job.run.bit_depth))
    if summary.lean is not None:
        print(lean_sentence(summary.lean))
    if summary.unlevelled_deg is not None and "tilt" not in outputs and not job.known.tilts:
        print(
            "positions are not levelled: pitch and roll are assumed unknown within "
            f"{summary.unlevelled_deg:g} degrees, as some frames show (detect all levels them)"
        )
    if circles and circles.refine and camera and camera.covariance is None:
        print(
            "the calibration has no covariance: its error is assumed to be "
            f"{circles.calibration_px:g} px (--calibration-px)"
        )
    elif circles and circles.refine and camera and any(camera.covariance or ()):
        from detect.levelling import calibration_share  # loads the compiler

        print(calibration_share(outputs["circles"], camera))
    if summary.rejected:
        causes = ", ".join(f"{cause} {count}" for cause, count in sorted(summary.rejected.items()))
        print(f"rejected: {causes}")


def _other_frames(plan: FramePlan, summary: RunSummary) -> str:
    """How the discs of frames without a tilt are treated, if there are any."""
    others = summary.frames - summary.failed - summary.found["tilts"]
    if plan.circles is None or plan.levelling == "none" or others == 0:
        return ""
    sigma_deg = summary.unlevelled_deg or math.degrees(plan.circles.tilt_sigma_rad)
    if sigma_deg == 0.0:
        return f"; the other {others} are assumed exactly level (see --tilt-sigma-deg)"
    return f"; the other {others} are assumed level within {sigma_deg:g} degrees"
