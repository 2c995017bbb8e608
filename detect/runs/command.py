"""The commands ``detect circles``, ``lines``, ``markers`` and ``all``: a run in, files out."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from camera import Camera
from detect.errors import DetectError, FrameError, WorkerError
from detect.line_settings import LineSettings
from detect.options import All, Circles, DetectorFlags, DiscIdOptions, Lines, Markers
from detect.row_files import KINDS, RunRows, read_head
from detect.runs.outputs import frames_tilt_place, lean_sentence
from detect.runs.plan import FramePlan, FramesByImage, Job, Known, MapByImage, RunSummary
from detect.runs.stream import detect_run
from detect.runs.workers import Workers, cluster_workers, default_jobs, local_workers
from detect.seen import leaning_camera
from detect.settings import CircleSettings
from detect.sources.interface import ImageRun, Run, read_image
from detect.sources.opening import demand_recording, open_run, open_source
from detect.sources.poses import SomeFrames
from detect.terminal import progress_bar, report_failures
from redetect.array_types import ByteArray
from redetect.landmarks import read_tilts
from redetect.messages import counted

#: Approximate number of images from which the radius of the discs is estimated.
_RADIUS_IMAGES = 12
#: Runs of at least `_FEWEST_FRAMES` frames get a warning if few discs are found and the logarithms
#: of the likely and the given radius differ by `_OTHER_RADIUS`.
_FEWEST_FRAMES, _OTHER_RADIUS = 10, 0.15
#: Other settings are worth mentioning if they find this many times as many discs.
_MANY = 3
#: Number of images in which the discs' size is compared with their radius, and the difference of
#: logarithms that is reported: .06 on run e, whose camera leans by 2.5 degrees.
_COMPARED_IMAGES, _OTHER_HEIGHT = 8, 0.07


def perform(command: DetectorFlags) -> int:
    """Carry a command out; returns the exit code."""
    job = replace(
        _job_of(command),
        command=type(command).__name__.lower(),
        crlf=command.line_ends == "crlf",
        overwrite=command.force,
        strict=command.strict,
        resume=command.resume,
    )
    workers = _workers(command, job)
    pictures = getattr(command, "draw", None)
    if pictures is not None:
        demand_recording(command.run)
        pictures.mkdir(parents=True, exist_ok=True)
    with progress_bar(", ".join(job.places), job.run.frames.expected) as advance:
        summary = detect_run(job, workers, advance)
    if pictures is not None:
        from detect.drawing.command import draw_run  # loads the detectors

        files = {kind: path for kind, path in job.places.items() if kind in KINDS}
        plan = job.plan if getattr(command, "rejected", False) else None
        draw_run(job.run, RunRows(files), pictures, plan, overwrite=command.force)
    _print_results(job, summary)
    for hint in _hints(job, summary):
        print(hint, file=sys.stderr)
    if summary.images_without_step:
        print(f"{summary.images_without_step} {job.run.frames.why_left_out}")
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
    places = {"circles": _output(command, run, "circles")}
    if command.json is not None:
        places["json"] = command.json
    settings = _with_radius(command.detector, run) if command.find_radius else command.detector
    bare = command.tilt == Path("none")
    plan = FramePlan(run.camera, circles=settings, levelling="none" if bare else "frame")
    tilts = None if bare or command.tilt is None else read_tilts(command.tilt)
    return Job(run, plan, places, replace(_known_discs(command.ids), tilts=tilts))


def _lines(command: Lines, run: Run) -> Job:
    output = _output(command, run, "lines")
    plan = FramePlan(run.camera, lines=_joined(command.detector, command.join_threshold, run))
    places = {"lines": output, "tilt": command.tilt or output.with_suffix(".tilt")}
    return Job(run, plan, places, Known(lines=_frames(command.ids_from)))


def _joined(settings: LineSettings, threshold_rad: float | None, run: Run) -> LineSettings:
    if threshold_rad is None:
        return settings
    # On the horizon straight ahead, a bearing of one radian is scale_x pixels wide.
    return replace(settings, join_px=threshold_rad * run.camera.scale_x)


def _markers(command: Markers) -> Job:
    run = open_source(command.run, command.camera, command.source)
    plan = FramePlan(run.camera if isinstance(run, Run) else None, markers=command.detector)
    return Job(run, plan, {"markers": _output(command, run, "markers")})


def _all(command: All, run: Run) -> Job:
    if command.output is not None:
        command.output.mkdir(parents=True, exist_ok=True)
    places = {
        kind: run.output(kind) if command.output is None else command.output / f"detected.{kind}"
        for kind in ("lines", "tilt", "circles")
    }
    circles = _with_radius(command.circles, run) if command.find_radius else command.circles
    lines = _joined(command.lines, command.join_threshold, run)
    return Job(
        run,
        FramePlan(run.camera, lines=lines, circles=circles, levelling=command.tilt),
        places,
        replace(_known_discs(command.ids), lines=_frames(command.line_ids_from)),
        base=places["lines"].with_suffix(""),
    )


def _with_radius(settings: CircleSettings, run: Run) -> CircleSettings:
    """The settings with the radius estimated from some of the images."""
    from detect.discs.radius import find_radius

    images = list(_some_images(run))
    found = find_radius(images, run.camera, settings)
    if found is None:
        raise DetectError(
            f"{len(images)} images: the radius of the discs cannot be estimated from them: "
            "expected some discs on the floor, or --radius-m"
        )
    print(
        f"discs have a radius of {found.radius_m:.4f} +- {found.sigma_m:.4f} m, estimated from "
        f"{found.discs} of them in {len(images)} images",
        file=sys.stderr,
    )
    return replace(settings, radius_m=round(found.radius_m, 4))


def _some_images(run: Run, count: int = _RADIUS_IMAGES) -> Iterator[ByteArray]:
    """Images spread over a run, if its length is known in advance."""
    if run.frames.expected is None:
        raise DetectError("--find-radius: expected recorded images, which can be read twice")
    step = max(1, run.frames.expected // count)
    for frame in SomeFrames(run.frames, step * count, step):
        with suppress(FrameError):
            yield read_image(frame, run.camera)


def _output(command: DetectorFlags, run: ImageRun, kind: str) -> Path:
    """The file for a command's result."""
    output = command.output if command.output is not None else run.output(kind)
    if not output.name:  # what an empty word becomes, too
        raise DetectError(f"{output}: is a folder: expected an output file")
    return output


def _frames(path: Path | None) -> FramesByImage | None:
    return None if path is None else FramesByImage(path)


def _known_discs(options: DiscIdOptions) -> Known:
    """Discs with IDs from files."""
    if (options.ids_from_map is None) != (options.path is None):
        raise DetectError("--ids-from-map and --path: expected both or neither")
    mapped = None
    if options.ids_from_map is not None and options.path is not None:
        mapped = MapByImage(options.ids_from_map, options.path)
    level = options.ids_from is not None and read_head(options.ids_from).level
    return Known(discs=_frames(options.ids_from), discs_level=level, mapped=mapped)


def _workers(command: DetectorFlags, job: Job) -> Workers:
    """The workers of a command."""
    frames = job.run.frames
    if command.cluster is not None:
        if command.jobs is not None:
            raise WorkerError("--jobs and --cluster: expected one of them")
        return cluster_workers(command.cluster, large=frames.ships_images)
    jobs = command.jobs if command.jobs is not None else default_jobs(frames.expected or 0)
    return local_workers(jobs, large=frames.ships_images, shared=True)


def _print_results(job: Job, summary: RunSummary) -> None:
    found, places, tilt = summary.found, job.places, summary.tilt
    frames = counted(summary.frames, "frame")
    if "lines" in places:
        print(f"{places['lines']}: {counted(found['lines'], 'line')} in {frames}")
    if "tilt" in places and tilt is not None:
        place = frames_tilt_place(places["tilt"])
        print(f"{place}: the separate tilts of {counted(found['tilts'], 'frame')}")
        print(f"{places['tilt']}: {tilt.sentence()}")
    elif "tilt" in places:
        others = _other_frames(job.plan, summary)
        print(f"{places['tilt']}: the tilt of {counted(found['tilts'], 'frame')}{others}")
    for kind, what in (("circles", "disc"), ("markers", "marker")):
        if kind in places:
            print(f"{places[kind]}: {counted(found[f'{what}s'], what)} in {frames}")
    if summary.lean is not None:
        print(lean_sentence(summary.lean))
    if summary.unlevelled_deg is not None and "tilt" not in places and not job.known.tilts:
        print(
            "positions are not levelled: pitch and roll are assumed unknown within "
            f"{summary.unlevelled_deg:g} degrees, as some frames show (detect all levels them)"
        )
    camera, circles = job.plan.camera, job.plan.circles
    if circles and circles.refine and camera and camera.covariance is None:
        print(
            "the calibration has no covariance: its error is assumed to be "
            f"{circles.calibration_px:g} px (--calibration-px)"
        )
    elif circles and circles.refine and camera and any(camera.covariance or ()):
        from detect.levelling import sentence_of  # loads the compiler

        print(sentence_of(places["circles"], camera))
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


def _hints(job: Job, summary: RunSummary) -> Iterator[str]:
    """Reasons why hardly anything was found, and what to try."""
    plan, camera, found = job.plan, job.plan.camera, summary.found
    if job.known != Known() and not summary.known:
        yield (
            "no image of this run is in the files of known tilts or IDs, or they have no rows: "
            "were they made from other images?"
        )
    others = summary.rejected["no matching pattern"]
    if plan.markers and not found["markers"] and others >= summary.frames:
        yield (
            f"{others} squares look like markers, but not of the dictionary "
            f"{plan.markers.dictionary}: is it the right one (--dictionary)?"
        )
    if camera is None:
        return
    if plan.lines is not None and not found["lines"]:
        from lut import cached_vertical_table

        if not cached_vertical_table(camera).usable.any():
            yield (
                "no verticals: according to the calibration, the camera looks too far above or "
                "below the horizon, or lies on its side"
            )
    if camera.seen_share < 1.0:
        yield (
            "according to the calibration, the distortion is not invertible in all of the image: "
            f"only {100 * camera.seen_share:.0f} % of the pixels are used"
        )
    seen = summary.frames - summary.failed
    run, settings = job.run, plan.circles
    if not (isinstance(run, Run) and settings and settings.refine) or run.frames.expected is None:
        return
    leaning = camera if summary.lean is None else leaning_camera(camera, summary.lean)
    if not found["discs"] or (found["discs"] < seen >= _FEWEST_FRAMES):
        yield from _hints_on_discs(run, leaning, settings, summary)
    elif seen >= _FEWEST_FRAMES:
        from detect.discs.radius import ratio_of_radii

        ratio = ratio_of_radii(list(_some_images(run, _COMPARED_IMAGES)), leaning, settings)
        if ratio is not None and abs(math.log(ratio)) > _OTHER_HEIGHT:
            yield (
                f"the discs look {ratio:.2f} times as large as with a radius of "
                f"{settings.radius_m:g} m: if that is right, the camera is not as high as "
                "calibrated, or leans, and positions are wrong by as much; measure the discs and "
                "its height"
            )


def _hints_on_discs(
    run: Run, camera: Camera, settings: CircleSettings, summary: RunSummary
) -> Iterator[str]:
    """Why a run has less than one disc per frame; nothing if no other settings find more."""
    from detect.discs.radius import find_radius
    from detect.discs.unfound import why_none

    images, number = list(_some_images(run)), summary.found["discs"]
    in_images = f"in {len(images)} of the images"
    discs = (
        f"{counted(number, 'disc')} of radius {settings.radius_m:g} m in "
        f"{counted(summary.frames, 'frame')}. "
    )
    if not number:
        discs += f"{why_none(images, camera, settings)} "
    if summary.frames < _FEWEST_FRAMES:
        yield discs + (
            "If discs are visible, try --radius-m auto, which estimates their radius, and check "
            "the calibration against the images (`detect draw`)."
        )
        return
    likely = find_radius(images, camera, replace(settings, polarity="any"))
    if likely and likely.discs <= _MANY * len(images) * number / summary.frames:
        likely = None  # not worth mentioning
    if likely and abs(math.log(likely.radius_m / settings.radius_m)) > _OTHER_RADIUS:
        yield discs + (
            f"Their radius seems to be {likely.radius_m:.3f} m: {likely.discs} of them are found "
            f"{in_images}. Try --radius-m {likely.radius_m:.3f}; if they are not that "
            f"{'small' if likely.radius_m < settings.radius_m else 'large'}, the camera has "
            "another height or pitch, or the calibration is not its own (`detect draw` shows "
            "outlines)."
        )
    elif likely and settings.polarity != "any":
        yield discs + f"--polarity any finds {likely.discs} {in_images}."
    elif _MANY * number < summary.frames:
        yield discs + (
            f"Other radii find no more {in_images}: is the calibration that of this camera "
            "(`detect draw` shows outlines; are its rows full or half?), are discs visible?"
        )
