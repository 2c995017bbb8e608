"""``camera level``: a camera's mounting from a run: its constant lean, and its height.

The command is one of the program `camera`; it is implemented here because it needs detection.

The lean is estimated from the verticals of all frames (`detect.run_tilt`), the height from the
outlines of discs of known size: with a wrong height, their pitch differs from that of the verticals
(`detect.discs.outline_tilt`). Both assume that the lens is calibrated correctly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from camera import Camera, write_camera
from camera.calibration.model import COUNT
from camera.model import PARAMETERS
from camera.options import Level
from camera.rotations import left_jacobian
from camera.uncertainty import covariance_of, with_covariance
from detect.discs.outline_tilt import tilt_of_outlines
from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.projection import leaning_camera, level_matrix
from detect.run_tilt import COMMON_RAD, FrameTilts, camera_pitch_weights, frame_tilts, tilt_of_run
from detect.runs.frame import detect_batch
from detect.runs.plan import FramePlan, FrameTask
from detect.settings import LEAST_FRAMES, CircleSettings
from detect.sources.interface import Run
from detect.sources.opening import open_run
from detect.terminal import progress_bar, report_failures
from redetect.array_types import FloatArray
from redetect.storage import demand_place

#: Changes of the height at which outlines of discs are evaluated, relative to the calibrated one.
HEIGHT_STEPS = (-0.06, 0.0, 0.06)
#: Relative standard deviation of a radius: of the edge of a blurred disc, and of the print.
_RADIUS_SIGMA = 0.01
_STILL_SEEN = 0.9  #: Share of frames with discs that still has some at the estimated height.
_MOST_SIGMAS = 3.0  #: Largest deviation of the height that is estimated from there, sigmas.
#: Number of neighbouring frames that see the same discs.
_TOGETHER = 5.0
#: Indices of the pose's parameters in a calibration's covariance (`camera.uncertainty`).
_POSITION, _ROTATION = slice(COUNT, COUNT + 3), slice(COUNT + 3, PARAMETERS)
_LEAN_AND_HEIGHT = (COUNT + 3, COUNT + 4, COUNT + 2)


def perform(options: Level) -> int:
    """Execute the command; returns the exit code."""
    demand_place(options.output, overwrite=options.force)
    run = open_run(options.run, options.camera)
    mounting = _mounting(run, run.camera, options.radius_m)
    if abs(mounting.raised_m) > HEIGHT_STEPS[-1] * run.camera.centre[2]:
        # Far from the right height, only things of another size are taken for discs.
        again = _mounting(run, remounted(run.camera, mounting), options.radius_m)
        near = abs(again.raised_m) < _MOST_SIGMAS * again.raised_sigma_m
        if not near or again.frames_with_discs < _STILL_SEEN * mounting.frames_with_discs:
            mounting = replace(mounting, raised_m=math.nan, raised_sigma_m=math.nan)
    print("\n".join(mounting.sentences()))
    write_camera(remounted(run.camera, mounting), options.output, overwrite=options.force)
    print(f"written: {options.output}")
    return 0


def _mounting(run: Run, camera: Camera, radius_m: float) -> Mounting:
    """The mounting of a run's camera, compared with the given one."""
    height_m = float(camera.centre[2])
    plan = FramePlan(camera, LineSettings(), CircleSettings(radius_m=radius_m), levelling="none")
    tilts, apart, failures = [], [], []
    pitch_weights = camera_pitch_weights(camera)
    with progress_bar("verticals and outlines", run.frames.expected) as advance:
        for frame in run.frames:
            advance()
            (found,) = detect_batch([FrameTask(frame)], plan)
            if found.error is not None or found.unlevelled is None or found.image is None:
                failures.append(str(found.error))
                continue
            of_image = found.image, camera, found.unlevelled.floor_xy, radius_m
            outlines = [tilt_of_outlines(*of_image, share * height_m) for share in HEIGHT_STEPS]
            tilts.append(found.tilt)
            level = [frame_tilts([one]).tilt[0] for one in (found.tilt, *outlines)]
            apart.append(np.dot(np.subtract(level[1:], level[0]), pitch_weights))
    report_failures(len(failures), failures)
    if not tilts:
        raise DetectError(f"{run.folder}: none of its images could be processed")
    mounting = mounting_of_run(height_m, frame_tilts(tilts), np.array(apart))
    if mounting is None:
        raise DetectError(
            f"{run.folder}: too few frames with a tilt from verticals: expected {LEAST_FRAMES}; "
            "drive where doors, shelves or walls are visible"
        )
    return mounting


@dataclass(frozen=True, eq=False)
class Mounting:
    """How a camera is mounted, compared with its calibration."""

    tilt_rad: FloatArray  # (2,) pitch and roll that level measured directions
    sigma_rad: FloatArray  # (2,) their standard deviations, including errors of the lens
    raised_m: float  # higher than calibrated; NaN if there are too few discs
    raised_sigma_m: float
    frames: int  # with a tilt from verticals
    frames_with_discs: int  # those that contribute to the height

    def sentences(self) -> list[str]:
        """The result in words."""
        (pitch, roll), sigmas = np.degrees(self.tilt_rad), np.degrees(self.sigma_rad)
        lines = [
            f"the camera leans {pitch:.2f} +- {sigmas[0]:.2f} degrees (pitch) and {roll:.2f} +- "
            f"{sigmas[1]:.2f} (roll) from its calibration, by the verticals of {self.frames} frames"
        ]
        if math.isnan(self.raised_m):
            lines.append("its height is unchanged: too few discs of that radius to estimate it")
        else:
            lines.append(
                f"its height is {100.0 * self.raised_m:+.1f} +- {100.0 * self.raised_sigma_m:.1f} "
                f"cm off the calibrated one, by the discs of {self.frames_with_discs} frames"
            )
        return lines


def mounting_of_run(
    height_m: float, verticals: FrameTilts, apart_rad: FloatArray
) -> Mounting | None:
    """Estimate the mounting from a run; None if too few frames have a tilt from verticals.

    From the calibrated height of the camera, the tilts of N frames, and the camera's pitch (N, 3)
    from the outlines of discs with the height changed by each of `HEIGHT_STEPS`, relative to that
    from verticals; NaN without either.
    """
    run = tilt_of_run(verticals)
    if run is None:
        return None
    known = np.isfinite(apart_rad).all(axis=1)
    raised_m = sigma_m = math.nan
    count = int(np.count_nonzero(known))
    if count >= LEAST_FRAMES:
        # Pitch from outlines is nearly linear in the height; frames share the slope.
        lower, same, higher = apart_rad[known].T
        slope = float(np.median(higher - lower)) / (HEIGHT_STEPS[2] - HEIGHT_STEPS[0])
        bend = float(np.median(higher + lower - 2.0 * same)) / HEIGHT_STEPS[2] ** 2
        off = float(np.median(same))
        share = -off / slope
        for _ in range(5):
            share = -(off + 0.5 * bend * share**2) / slope
        spread = 1.4826 * float(np.median(np.abs(same - off)))
        statistical = spread * math.sqrt(0.5 * math.pi * _TOGETHER / count) / abs(slope)
        raised_m = share * height_m
        sigma_m = height_m * math.hypot(statistical, COMMON_RAD / slope, _RADIUS_SIGMA)
    frames = int(np.count_nonzero(verticals.known))
    return Mounting(run.lean, run.lean_sigma, raised_m, sigma_m, frames, frames_with_discs=count)


def remounted(camera: Camera, mounting: Mounting) -> Camera:
    """The camera as it is mounted, turned about the robot's origin on the floor.

    If it states its covariance, that of its pitch, roll and (where there is one) height becomes the
    mounting's; the rest stays.
    """
    turn = level_matrix(mounting.tilt_rad)
    raised_m = 0.0 if math.isnan(mounting.raised_m) else mounting.raised_m
    pitch, roll = mounting.tilt_rad
    moved = leaning_camera(camera, (pitch, roll), raised_m)
    covariance = covariance_of(camera)
    if covariance is None:
        return moved
    sigmas = np.append(mounting.sigma_rad, mounting.raised_sigma_m)
    turned = left_jacobian(np.append(mounting.tilt_rad, 0.0))[:, :2]
    by_mounting = np.zeros((PARAMETERS, 3))
    by_mounting[_POSITION] = np.column_stack([np.cross(turned.T, moved.centre).T, turn[:, 2]])
    by_mounting[_ROTATION, :2] = turned
    found = np.isfinite(sigmas)
    replaced = np.array(_LEAN_AND_HEIGHT)[found]
    covariance[replaced] = covariance[:, replaced] = 0.0
    by_mounting = by_mounting[:, found] * sigmas[found]
    return with_covariance(moved, covariance + by_mounting @ by_mounting.T)
