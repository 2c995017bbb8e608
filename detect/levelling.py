"""Errors that all discs of a frame share: the robot's tilt, and the camera's calibration.

The robot tilts about the origin of its frame on the floor, by pitch and roll. Its camera, at c, is
calibrated for a level robot: a disc seen at p is on the ray c + s (p - c). Levelled by R, that ray
meets the floor at

    q = R (c + s (p - c)),    s = -(R c)_z / (R (p - c))_z    (`detect.projection.level_positions`).

The covariance of q is J diag(C_p, C_tilt) J^T, J = dq / d(p, pitch, roll).

Calibration errors are common to all rows. With the covariance C of the calibration's parameters
(`camera.uncertainty`) and the derivatives J of a position by them, they contribute J C J^T to a
covariance. If positions are levelled by verticals, the tilt from the same camera depends on the
calibration, too: errors of the mounting's tilt cancel, and effects of the lens on verticals are
added. Without C, the calibration is assumed to have an error of a fraction of a pixel everywhere
(`CircleSettings.calibration_px`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from camera import Camera
from camera.model import inverse_2x2
from camera.uncertainty import covariance_of, floor_by_parameters, tilt_by_parameters
from detect.circles import CircleDetections
from detect.discs.positions import refined_covariance
from detect.projection import level_positions
from redetect.array_types import BoolArray, FloatArray
from redetect.landmarks import FrameTilt, circle_arrays, read_frames

_STEP = 1e-6  #: Step of central differences of levelled positions, metres and radians.

_tilt_by_parameters = lru_cache(maxsize=4)(tilt_by_parameters)


def levelled(found: CircleDetections, camera: Camera, tilt: FrameTilt) -> CircleDetections:
    """The same discs, their positions and covariances corrected for the tilt of their frame.

    Discs above the horizon of the levelled camera are dropped.
    """
    tilts = tilt_arrays([tilt])
    floor_xy, covariance, on_floor = level_discs(camera, found.floor_xy, found.covariance, *tilts)
    by = tilt.pitch, tilt.roll
    return replace(found, floor_xy=floor_xy, covariance=covariance, levelled_by=by).where(on_floor)


def as_calibrated(found: CircleDetections, leaning: Camera, camera: Camera) -> CircleDetections:
    """Convert discs of a leaning camera to the floor positions of the camera as calibrated.

    Discs above the horizon of the latter are dropped.
    """
    pixels = leaning.project_floor(found.floor_xy)
    floor_xy = camera.floor_from_pixel(pixels)
    jacobian = camera.floor_jacobian(pixels) @ inverse_2x2(leaning.floor_jacobian(pixels))
    covariance = jacobian @ found.covariance @ jacobian.swapaxes(1, 2)
    level = replace(found, floor_xy=floor_xy, covariance=covariance)
    return level.where(np.asarray(np.isfinite(floor_xy).all(axis=-1)))


def tilt_arrays(tilts: Sequence[FrameTilt]) -> tuple[FloatArray, FloatArray]:
    """(N, 2) pitch and roll (rad) and their (N, 2, 2) covariances (rad^2)."""
    numbers = np.array([(t.pitch, t.roll, t.cpp, t.cpr, t.crr) for t in tilts]).reshape(-1, 5)
    return numbers[:, :2], numbers[:, [2, 3, 3, 4]].reshape(-1, 2, 2)


def level_discs(
    camera: Camera,
    floor_xy: FloatArray,
    covariance: FloatArray,
    tilt: FloatArray,
    tilt_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Positions (N, 2) on the floor (m) and their covariances, corrected for tilts.

    Positions are those of the calibrated camera on a level robot. Pitch and roll (rad) and their
    covariances are given for each position, (N, 2) and (N, 2, 2), or once for all. The returned
    covariances are the propagated ones of the positions plus those due to the tilt. If the levelled
    ray does not meet the floor, numbers are NaN and the mask is false.
    """
    steps = _STEP * np.vstack([np.zeros(4), np.eye(4), -np.eye(4)])[:, None]
    level_xy, *ends = level_positions(camera, floor_xy + steps[..., :2], tilt + steps[..., 2:])
    jacobian = np.stack([ends[k] - ends[k + 4] for k in range(4)], axis=-1) / (2.0 * _STEP)
    of_all = np.zeros((len(floor_xy), 4, 4))
    of_all[:, :2, :2] = covariance
    of_all[:, 2:, 2:] = tilt_covariance
    level_covariance = jacobian @ of_all @ jacobian.swapaxes(1, 2)
    on_floor = np.isfinite(level_xy).all(axis=1) & np.isfinite(level_covariance).all(axis=(1, 2))
    return level_xy, level_covariance, np.asarray(on_floor)


def common_covariance(
    camera: Camera, floor_xy: FloatArray, unstated_px: float, *, by_verticals: bool | BoolArray
) -> FloatArray:
    """(N, 2, 2) covariances (m^2) of positions on the floor (N, 2) due to the calibration's errors.

    `unstated_px` is the error of a camera without a covariance; `by_verticals`, for each (N,) or
    all, whether positions are levelled by verticals of the same camera.
    """
    nothing = np.zeros((len(floor_xy), 2, 2))
    covariance = covariance_of(camera)
    if covariance is None:
        return refined_covariance(camera, floor_xy, nothing, unstated_px, tilt_sigma_rad=0.0)
    if len(floor_xy) == 0 or not covariance.any():
        return nothing
    jacobian = floor_by_parameters(camera, floor_xy)
    if np.any(by_verticals):
        steps = _STEP * np.vstack([np.eye(2), -np.eye(2)])
        p, r, minus_p, minus_r = level_positions(camera, floor_xy, steps[:, None])
        by_tilt = np.stack([p - minus_p, r - minus_r], axis=-1) / (2.0 * _STEP)
        by_tilt = np.where(np.reshape(by_verticals, (-1, 1, 1)), by_tilt, 0.0)
        jacobian = jacobian + by_tilt @ _tilt_by_parameters(camera)
    return np.asarray(jacobian @ covariance @ jacobian.swapaxes(1, 2))


def common_tilt_variance(camera: Camera) -> FloatArray | None:
    """(2,) variances of pitch and roll from verticals that are common to all frames, rad^2.

    None if the camera has no covariance.
    """
    covariance = covariance_of(camera)
    if covariance is None:
        return None
    jacobian = _tilt_by_parameters(camera)
    return np.asarray(np.diag(jacobian @ covariance @ jacobian.T))


def calibration_share(circles: Path, camera: Camera) -> str:
    """A sentence on the calibration's share of the variances in a file's rows."""
    shares: list[float] = []
    for frame in read_frames(circles):
        rows = circle_arrays(frame.circles)
        by_verticals = frame.levelled_by is not None and any(frame.levelled_by)
        common = common_covariance(camera, rows.xy, 0.0, by_verticals=by_verticals)
        traces = [np.trace(c, axis1=1, axis2=2) for c in (common, rows.covariance)]
        shares += (traces[0] / traces[1]).tolist()
    share = 100.0 * float(np.median(shares)) if shares else 0.0
    return (
        f"{share:.0f} % of the discs' variance (median) are due to the calibration, according to "
        "its file: a common error of all rows"
    )
