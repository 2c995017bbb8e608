"""Projection of floor positions into the image, and their correction for the tilt.

Plain NumPy, so that comparing files does not load the compiler.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from camera import Camera
from camera.model import points_on_floor
from camera.model_checks import checked_pose
from camera.rotations import rotation_of
from detect.settings import USUAL_TILT_DEG, CircleSettings
from redetect.array_types import FloatArray
from redetect.landmarks import Frame, Step
from redetect.plane import chain_steps

#: Pitch and roll (rad) that level directions: those of a frame, or the constant lean of a camera
#: against its calibration.
Tilt = tuple[float, float]

LEAST_GATE_PX = 3.0  #: Lower bound of the gate in the image, for small discs (px).
#: Deviations of the unknown tilt by which rows that are not levelled may be off from level ones.
_TILT_GATE = 3.0
_POINTS = 64


def image_positions(
    camera: Camera, floor_xy: ArrayLike, levelled_by: Tilt | None = None, raised_m: float = 0.0
) -> FloatArray:
    """(..., 2) pixels of positions (..., 2) on the floor (m); NaN where not visible.

    `levelled_by` are pitch and roll (rad) by which the positions were levelled, and the camera is
    `raised_m` higher than calibrated.
    """
    points = points_on_floor(floor_xy)
    if levelled_by is not None:
        # The rotation levels measured directions; its transpose undoes that.
        points = points @ level_rotation(levelled_by)
    return camera.project_robot(points - np.array([0.0, 0.0, raised_m]))


def level_positions(
    camera: Camera, floor_xy: ArrayLike, levelled_by: ArrayLike, raised_m: float = 0.0
) -> FloatArray:
    """Level the floor positions (m) that the calibrated camera measures.

    Positions (..., 2) were computed without the tilt; pitch and roll (..., 2) (rad) are given once
    for all or broadcast against them. NaN where the levelled ray does not meet the floor.
    """
    turn = level_rotation(levelled_by)
    rays = (turn @ (points_on_floor(floor_xy) - camera.centre)[..., None])[..., 0]
    centre = turn @ (camera.centre + np.array([0.0, 0.0, raised_m]))
    down = np.where(rays[..., 2:] < 0.0, rays[..., 2:], np.nan)
    return np.asarray(centre[..., :2] - centre[..., 2:] / down * rays[..., :2])


def level_rotation(levelled_by: ArrayLike) -> FloatArray:
    """(..., 3, 3) rotations exp([pitch, roll, 0]x) that level measured directions.

    `detect.verticals.tilt.levelling_rotation` is the kernel.
    """
    tilt = np.asarray(levelled_by, dtype=np.float64)
    return rotation_of(np.concatenate([tilt, np.zeros_like(tilt[..., :1])], axis=-1))


def leaning_camera(camera: Camera, lean: Tilt, raised_m: float = 0.0) -> Camera:
    """The camera mounted higher, then leaning by pitch and roll (rad).

    These level directions, about the robot's origin on the floor. The covariance is dropped.
    """
    turn = level_rotation(lean)
    centre = camera.centre + np.array([0.0, 0.0, raised_m])
    pose = np.column_stack([turn @ camera.rotation, turn @ centre])
    return replace(camera, robot_from_camera=checked_pose("sensor2World", pose), covariance=None)


def circle_on_floor(centre_xy: ArrayLike, radius_m: float, points: int = _POINTS) -> FloatArray:
    """(..., points, 2) points on circles on the floor (m)."""
    angle = 2.0 * np.pi * np.arange(points) / points
    ring = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(np.asarray(centre_xy, dtype=np.float64)[..., None, :] + ring)


def summed_steps(steps: Iterable[Step]) -> FloatArray:
    """(N + 1, 3) poses along N steps, the start first: x, y (m), heading (rad) in its frame."""
    return chain_steps([(step.dx, step.dy, step.dphi) for step in steps])


@dataclass(frozen=True)
class DiscProjection:
    """Projects reference and detected discs into the image, each by the tilt that levelled them."""

    camera: Camera
    settings: CircleSettings = field(default_factory=CircleSettings)  # of the detected discs
    #: Reference rows are level but do not state their tilt: that of the detected rows is used.
    reference_level: bool = False
    reference_tilt: Tilt | None = None  # that levelled the reference rows
    detected_tilt: Tilt | None = None

    def for_frame(self, reference: Frame | None, detected: Frame | None) -> DiscProjection:
        """The projection of a frame with these rows."""
        detected_tilt = None if detected is None else detected.levelled_by
        reference_tilt = None if reference is None else reference.levelled_by
        if self.reference_level and reference_tilt is None:
            reference_tilt = detected_tilt
        return replace(self, reference_tilt=reference_tilt, detected_tilt=detected_tilt)

    def reference_px(self, xy: FloatArray) -> FloatArray:
        """(..., 2) pixels of positions (..., 2) of reference rows."""
        return image_positions(self.camera, xy, self.reference_tilt)

    def detected_px(self, xy: FloatArray) -> FloatArray:
        """(..., 2) pixels of positions (..., 2) of detected rows."""
        return image_positions(self.camera, xy, self.detected_tilt)

    def levelled_as_detected(self, reference_xy: FloatArray) -> FloatArray:
        """(N, 2) reference positions levelled as the detected ones are; as they are where the
        levelled ray does not meet the floor.
        """
        if self.reference_tilt == self.detected_tilt:
            return reference_xy
        xy = self.camera.floor_from_pixel(self.reference_px(reference_xy))
        if self.detected_tilt is not None:
            xy = level_positions(self.camera, xy, self.detected_tilt)
        return np.where(np.isfinite(xy), xy, reference_xy)

    def gates(self, reference_xy: FloatArray) -> FloatArray:
        """(N, 2) half widths and heights of imaged discs, at least `LEAST_GATE_PX`, pixels.

        Wider where the tilt between the reference and the detected rows is unknown.
        """
        radius_m = self.settings.radius_m
        edge = self.reference_px(circle_on_floor(reference_xy.reshape(-1, 2), radius_m, 16))
        visible = np.isfinite(edge)
        low = np.where(visible, edge, np.inf).min(axis=1, initial=np.inf)
        high = np.where(visible, edge, -np.inf).max(axis=1, initial=-np.inf)
        gates = np.maximum(0.5 * (high - low), LEAST_GATE_PX)
        if self.reference_level and self.detected_tilt is None:
            sigma_rad = max(self.settings.tilt_sigma_rad, math.radians(USUAL_TILT_DEG))
            gates += _TILT_GATE * sigma_rad * np.array(self.camera.pinhole[:2])
        return np.asarray(gates)
