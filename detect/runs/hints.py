"""Reasons why hardly anything was found in a run, and what to try."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

from detect.errors import DetectError, FrameError
from detect.runs.plan import Job, Priors, RunSummary
from detect.settings import UNREFINED, CircleSettings
from detect.sources.grey_images import read_image
from detect.sources.interface import Run, spread_frames
from redetect.array_types import ByteArray
from redetect.messages import counted

#: Approximate number of images from which the radius of the discs is estimated.
_RADIUS_IMAGES = 12
#: Runs of at least `_FEWEST_FRAMES` frames get a warning if less than `_FEW_DISCS` per frame are
#: found (parts of larger discs are, or look-alikes) and the logarithms of the likely and the given
#: radius differ by `_OTHER_RADIUS`.
_FEWEST_FRAMES, _FEW_DISCS, _OTHER_RADIUS = 10, 3, 0.15
#: Other settings are worth mentioning if they find this many times as many discs.
_MANY = 3
#: Number of images in which the discs' size is compared with their radius, and the difference of
#: logarithms that is reported.
_COMPARED_IMAGES, _OTHER_HEIGHT = 8, 0.07


def some_images(run: Run, count: int = _RADIUS_IMAGES) -> Iterator[ByteArray]:
    """Images spread over a recorded run."""
    if not run.frames.is_recorded:
        raise DetectError("--radius-m auto: expected recorded images, which can be read twice")
    for frame in spread_frames(run.frames, count):
        with suppress(FrameError):
            yield read_image(frame, run.camera)


def hints(job: Job, summary: RunSummary) -> Iterator[str]:
    """Reasons why hardly anything was found, and what to try."""
    plan, camera, found = job.plan, job.plan.camera, summary.found
    processed = summary.frames - summary.failed
    if not processed:
        return  # the reasons are listed frame by frame
    if job.known != Priors() and not summary.known:
        yield (
            "no image of this run is in the files of known tilts or IDs, or they have no rows: "
            "were they made from other images?"
        )
    others = summary.rejected["no matching pattern"]
    if plan.markers and not found["markers"] and others >= processed:
        yield (
            f"{others} squares look like markers, but not of the dictionary "
            f"{plan.markers.dictionary}: is it the right one (--dictionary)?"
        )
    if camera is None:
        return
    if plan.circles is not None and plan.circles.refine:
        default = CircleSettings()
        idle = [name for name in UNREFINED if getattr(plan.circles, name) != getattr(default, name)]
        if idle:
            yield (
                f"without effect on discs that are found by their rims: {', '.join(idle)} "
                "(--no-refine selects them by quality)"
            )
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
    run, settings = job.run, plan.circles
    if not (isinstance(run, Run) and settings and settings.refine and run.frames.is_recorded):
        return
    on_discs: list[str] = []
    few = processed >= _FEWEST_FRAMES and found["discs"] < _FEW_DISCS * processed
    if few or not found["discs"]:
        on_discs = list(_hints_on_discs(run, settings, summary))
    yield from on_discs
    if not on_discs and found["discs"] >= processed >= _FEWEST_FRAMES:
        from detect.lean import leaning_as
        from detect.radius import ratio_of_radii

        images = list(some_images(run, _COMPARED_IMAGES))
        # The lean of the search, which is partly by outlines, would hide a wrong height.
        leaning = leaning_as(images, camera, otherwise=summary.lean)
        ratio = ratio_of_radii(images, leaning, settings)
        if ratio is not None and abs(math.log(ratio)) > _OTHER_HEIGHT:
            yield (
                f"the discs look {ratio:.2f} times as large as with a radius of "
                f"{settings.radius_m:g} m: if that is right, the camera is not as high as "
                "calibrated, or leans, and positions are wrong by as much; measure the discs and "
                "its height"
            )


def _hints_on_discs(run: Run, settings: CircleSettings, summary: RunSummary) -> Iterator[str]:
    """Why a run has few discs per frame; nothing if no other settings find more."""
    from detect.explanation import why_none
    from detect.lean import leaning_as
    from detect.radius import find_radius

    images, number = list(some_images(run)), summary.found["discs"]
    processed = summary.frames - summary.failed
    if not images:  # by chance, all of these failed
        return
    camera = leaning_as(images, run.camera, otherwise=summary.lean)
    in_images = f"in {len(images)} of the images"
    frames = counted(processed, "frame")
    discs = f"{counted(number, 'disc')} of radius {settings.radius_m:g} m in {frames}. "
    if not number:
        discs += f"{why_none(images, camera, settings)} "
    if processed < _FEWEST_FRAMES:
        yield discs + (
            "If discs are visible, try --radius-m auto, which estimates their radius, and check "
            "the calibration against the images (`detect draw`)."
        )
        return
    likely = find_radius(images, camera, replace(settings, polarity="any"))
    if likely and likely.discs <= _MANY * len(images) * number / processed:
        likely = None  # not worth mentioning
    if likely and abs(math.log(likely.radius_m / settings.radius_m)) > _OTHER_RADIUS:
        yield discs + (
            f"Their radius seems to be {likely.radius_m:.3f} m: {likely.discs} of them are found "
            f"{in_images}. Try --radius-m {likely.radius_m:.3f}; if they are not that "
            f"{'small' if likely.radius_m < settings.radius_m else 'large'}, the camera has "
            "another height or pitch, or the calibration is not its own (`detect draw` shows "
            "outlines)."
        )
    elif likely and settings.polarity != "any" and number < processed:
        yield discs + f"--polarity any finds {likely.discs} {in_images}."
    elif _MANY * number < processed:
        yield discs + (
            f"Other radii find no more {in_images}: is the calibration that of this camera "
            "(`detect draw` shows outlines; are its rows full or half?), are discs visible?"
        )
