"""A camera's mounting from a run: its constant lean, and its height.

The lean is estimated from the verticals of all frames (`detect.run_tilt`), the height from the
outlines of discs of known size: with a wrong height, their pitch differs from that of the verticals
(`detect.discs.outline_tilt`). Both assume that the lens is calibrated correctly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from camera import Camera
from camera.calibration.model import COUNT
from camera.model import PARAMETERS
from camera.rotations import left_jacobian
from camera.uncertainty import covariance_of, with_covariance
from detect.projection import leaning_camera, level_rotation
from detect.run_tilt import COMMON_RAD, FrameTilts, tilt_of_run
from detect.settings import LEAST_FRAMES
from redetect.array_types import FloatArray
from redetect.messages import counted

#: Changes of the height at which outlines of discs are evaluated, relative to the calibrated one.
HEIGHT_STEPS = (-0.06, 0.0, 0.06)
#: Relative standard deviation of a radius: of the edge of a blurred disc, and of the print.
_RADIUS_SIGMA = 0.01
#: Largest change of the height that the outlines show, its largest standard deviation (both
#: relative to the height), and share of frames that mostly have discs.
_MOST_RAISED, _MOST_SIGMA, _FEW_DISCS = 0.6, 0.05, 0.4
_CORRELATED_FRAMES = 5.0  #: Number of neighbouring frames that see the same discs.
#: Indices of the pose's parameters in a calibration's covariance (`camera.uncertainty`).
_POSITION, _ROTATION = slice(COUNT, COUNT + 3), slice(COUNT + 3, PARAMETERS)
_LEAN_AND_HEIGHT = (COUNT + 3, COUNT + 4, COUNT + 2)


@dataclass(frozen=True, eq=False)
class Mounting:
    """How a camera is mounted, compared with its calibration."""

    tilt_rad: FloatArray  # (2,) pitch and roll that level measured directions
    sigma_rad: FloatArray  # (2,) their standard deviations, including errors of the lens
    raised_m: float  # higher than calibrated; NaN if the discs do not determine it
    raised_sigma_m: float
    frames: int  # with a tilt from verticals
    frames_with_discs: int  # those that contribute to the height

    def sentences(self) -> list[str]:
        """The result in words."""
        (pitch, roll), sigmas = np.degrees(self.tilt_rad), np.degrees(self.sigma_rad)
        lean = (
            f"the camera leans {pitch:.2f} +- {sigmas[0]:.2f} degrees (pitch) and {roll:.2f} +- "
            f"{sigmas[1]:.2f} (roll) from its calibration, by the verticals of {self.frames} frames"
        )
        if math.isnan(self.raised_m):
            why = (
                f"{counted(self.frames_with_discs, 'frame')} with the outlines of discs of that "
                f"radius: expected {LEAST_FRAMES}"
            )
            if self.frames_with_discs >= LEAST_FRAMES:
                why = "no height explains the outlines of the discs: is their radius right?"
            return [lean, f"its height is unchanged: {why}"]
        height = (
            f"its height is {100.0 * self.raised_m:+.1f} +- {100.0 * self.raised_sigma_m:.1f} "
            f"cm off the calibrated one, by the discs of {self.frames_with_discs} frames"
        )
        if self.frames_with_discs < _FEW_DISCS * self.frames:
            height += (
                "; most frames show none: if discs are mostly in view, the radius or the "
                "calibrated height is wrong, and so is this"
            )
        return [lean, height]


def mounting_of_run(
    height_m: float, verticals: FrameTilts, relative_pitch_rad: FloatArray
) -> Mounting | None:
    """Estimate the mounting from a run; None if too few frames have a tilt from verticals.

    From the calibrated height, the tilts of N frames, and the camera's pitch (N, 3) from outlines
    of discs, the height changed by `HEIGHT_STEPS`, minus that from verticals; NaN without either.
    """
    run = tilt_of_run(verticals)
    if run is None:
        return None
    known = np.isfinite(relative_pitch_rad).all(axis=1)
    raised_m = sigma_m = math.nan
    count = int(np.count_nonzero(known))
    if count >= LEAST_FRAMES:
        # Pitch from outlines is nearly linear in the height; frames share the slope.
        lower, same, higher = relative_pitch_rad[known].T
        slope = float(np.median(higher - lower)) / (HEIGHT_STEPS[2] - HEIGHT_STEPS[0])
        bend = float(np.median(higher + lower - 2.0 * same)) / HEIGHT_STEPS[2] ** 2
        off = float(np.median(same))
        share = 0.0 if slope else math.inf
        for _ in range(6 if slope else 0):
            share = -(off + 0.5 * bend * share**2) / slope
        if abs(share) < _MOST_RAISED:
            spread = 1.4826 * float(np.median(np.abs(same - off)))
            of_median = spread * math.sqrt(0.5 * math.pi * _CORRELATED_FRAMES / count)
            sigma = math.hypot(of_median / slope, COMMON_RAD / slope, _RADIUS_SIGMA)
            if sigma < _MOST_SIGMA:  # look-alikes contradict each other
                raised_m, sigma_m = share * height_m, sigma * height_m
    frames = int(np.count_nonzero(verticals.known))
    return Mounting(run.lean, run.lean_sigma, raised_m, sigma_m, frames, frames_with_discs=count)


def remounted(camera: Camera, mounting: Mounting) -> Camera:
    """The camera as it is mounted, turned about the robot's origin on the floor.

    If it states its covariance, that of its pitch, roll and (where there is one) height becomes the
    mounting's; the rest stays.
    """
    turn = level_rotation(mounting.tilt_rad)
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
