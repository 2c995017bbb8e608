"""Estimates the robot's tilt from the outlines of discs.

Projected to the floor of a level camera, the outline of a disc of known radius r is a circle. If
the robot tilts, the calibrated floor is another plane, on which the outline is an ellipse:

    | A(c; t) (p - c) | = r,

where p is a point of the outline on the calibrated floor, c the centre, t = (pitch, roll) the
rotation that levels measured directions, and A the derivative of levelling at c. Each disc whose
rim is visible (`detect.discs.rim`) gives an estimate of t by least squares in pixels; the robust
mean over the discs of a frame is its tilt. Errors of neighbouring rim points are correlated, paper
is not flat, and floors are uneven: constants below add these errors for a disc and for a frame.

The pose of a plane from the outline of a circle on it: D. Forsyth et al., Invariant Descriptors
for 3D Object Recognition and Pose, PAMI 13 (1991).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from camera import Camera
from camera.kernels import camera_numbers
from detect.discs.fit import eliminate, solve
from detect.discs.rim import COS, SIN, median, profiles, rim_points
from detect.verticals.tilt import levelling_rotation
from redetect.array_types import Float32Array, FloatArray, GreyImage
from redetect.compiled import kernel
from redetect.landmarks import FrameTilt

LEAST_DIRECTIONS = 24  #: Least number of directions in which the rim is on the ellipse.
LEAST_AXIS_PX = 1.2  #: Least semi-minor axis of the ellipse, pixels.
#: Least contrast, grey levels.
LEAST_CONTRAST = 8.0
POINT_SIGMA_PX = 0.25  #: Standard deviation of a rim point, pixels.
_CORRELATED_POINTS = 4.0  #: Number of neighbours with a common error.
#: Standard deviation of a single disc's tilt, and of the floor's below all discs of a frame.
DISC_SIGMA_RAD, FLOOR_SIGMA_RAD = math.radians(0.45), math.radians(0.3)

_STEP_RAD = 1e-4
_ITERATIONS = 7
_FREEDOM = 4.0  #: Degrees of freedom of Student's t distribution of the discs' tilts.
_MOST_TILT_RAD = 0.3
_DIRECTIONS_XY = np.stack([COS, SIN], axis=-1)


class OutlineTilt(NamedTuple):
    """Tilt from the outline of one disc."""

    found: bool  # whether enough of the outline is on the ellipse
    tilt: FloatArray  # (2,) pitch and roll, rad
    covariance: FloatArray  # (2, 2) from the points alone


def tilt_of_outlines(
    image: GreyImage, camera: Camera, floor_xy: FloatArray, radius_m: float, raised_m: float = 0.0
) -> FrameTilt | None:
    """Estimate the tilt from the outlines of the discs in an image; None if no rim is visible.

    `floor_xy` (N, 2) are the positions of the discs, not levelled; the camera is higher than
    calibrated by `raised_m`. The tilt's prefix is empty.
    """
    numbers, centre = camera_numbers(camera), np.array(camera.centre)
    # If the camera is higher than calibrated, discs are larger than they seem.
    radius = radius_m / (1.0 + raised_m / float(camera.centre[2]))
    radial, outlines = profiles(image, numbers, floor_xy, np.full(len(floor_xy), radius_m)), []
    for (x, y), grey, px_per_radius in zip(floor_xy, radial.grey, radial.pixels_per_radius):
        contrast = _contrast(grey)
        if not (px_per_radius.min() >= LEAST_AXIS_PX and abs(contrast) >= LEAST_CONTRAST):
            continue
        rim, _ = rim_points(grey, px_per_radius, contrast)
        if np.isfinite(rim).sum() >= LEAST_DIRECTIONS:
            point_xy = radius_m * rim[:, None] * _DIRECTIONS_XY
            outline = fit_outline(point_xy, px_per_radius / radius_m, centre, x, y, radius)
            outlines += [outline] if outline.found else []
    if not outlines:
        return None
    tilts = np.array([outline.tilt for outline in outlines])
    covariances = np.array([outline.covariance for outline in outlines])
    mean, covariance = mean_of_tilts(tilts, covariances + DISC_SIGMA_RAD**2 * np.eye(2))
    (cpp, cpr), (_, crr) = (covariance + FLOOR_SIGMA_RAD**2 * np.eye(2)).tolist()
    pitch, roll = mean.tolist()
    return FrameTilt("", pitch, roll, cpp, cpr, crr, len(tilts))


@kernel()
def _contrast(grey: Float32Array) -> float:
    """Mean grey level within half a radius minus that beyond one and a third."""
    return float(np.nanmean(grey[:, :4]) - np.nanmean(grey[:, -8:]))


@kernel()
def fit_outline(
    point_xy: FloatArray,
    px_per_m: FloatArray,
    centre: FloatArray,
    x: float,
    y: float,
    radius: float,
) -> OutlineTilt:
    """Estimate the tilt of one disc near (x, y) from (N, 2) points of its outline.

    Points are on the calibrated floor, relative to (x, y), metres; NaN where the outline is not
    visible. `px_per_m` is the scale of the image in each direction, `centre` the camera's.
    """
    count = len(point_xy)
    unknowns, step = np.zeros(4), np.zeros(4)  # centre, metres; pitch, roll
    weight, residual, row = np.zeros(count), np.zeros(count), np.zeros((count, 5))
    for k in range(count):
        weight[k] = 0.0 if math.isnan(point_xy[k, 0]) else 1.0
    normal, sigma = np.empty((5, 5, 1)), 0.0
    shapes, lengths, off = np.empty((5, 4)), np.empty(5), np.empty(count)
    for iteration in range(_ITERATIONS):
        pitch, roll = unknowns[2], unknowns[3]
        for i in range(5):
            by_pitch = _STEP_RAD * ((i == 1) - (i == 2))
            by_roll = _STEP_RAD * ((i == 3) - (i == 4))
            rotation = levelling_rotation(pitch + by_pitch, roll + by_roll)
            a, b, c, d = _derivative_of_levelling(rotation, centre, x, y)
            shapes[i, 0], shapes[i, 1], shapes[i, 2], shapes[i, 3] = a, b, c, d
        for k in range(count):
            if math.isnan(point_xy[k, 0]):
                continue
            px, py = point_xy[k, 0] - unknowns[0], point_xy[k, 1] - unknowns[1]
            for i in range(5):
                across = shapes[i, 0] * px + shapes[i, 1] * py
                along = shapes[i, 2] * px + shapes[i, 3] * py
                lengths[i] = math.sqrt(across**2 + along**2)
            a, b, c, d = shapes[0, 0], shapes[0, 1], shapes[0, 2], shapes[0, 3]
            across, along = (a * px + b * py) / lengths[0], (c * px + d * py) / lengths[0]
            residual[k] = (lengths[0] - radius) * px_per_m[k]
            row[k, 0] = -(across * a + along * c) * px_per_m[k]
            row[k, 1] = -(across * b + along * d) * px_per_m[k]
            row[k, 2] = (lengths[1] - lengths[2]) / (2.0 * _STEP_RAD) * px_per_m[k]
            row[k, 3] = (lengths[3] - lengths[4]) / (2.0 * _STEP_RAD) * px_per_m[k]
            row[k, 4] = -residual[k]
        if iteration > 1:
            # The first steps, from a level floor to the tilted one, use all points.
            used = 0
            for k in range(count):
                if weight[k] > 0.0:
                    off[used] = abs(residual[k])
                    used += 1
            sigma = max(0.1, 1.48 * median(off[:used]))
            for k in range(count):
                if weight[k] > 0.0:
                    weight[k] = 1.0 / (1.0 + (residual[k] / (2.0 * sigma)) ** 2) ** 2
        for i in range(5):
            for j in range(i + 1):
                normal[i, j, 0] = 0.0
                for k in range(count):
                    normal[i, j, 0] += weight[k] * row[k, i] * row[k, j]
        solve(normal.copy(), step)
        for i in range(4):
            unknowns[i] += step[i]
    on = 0
    squares = weights = 0.0
    for k in range(count):
        on += weight[k] > 0.0 and abs(residual[k]) < 3.0 * sigma
        squares += weight[k] * residual[k] ** 2
        weights += weight[k]
    variance = max(squares / weights, POINT_SIGMA_PX**2) * _CORRELATED_POINTS
    eliminate(normal, range(2))
    pp, pr, rr = normal[2, 2, 0], normal[3, 2, 0], normal[3, 3, 0]
    area = pp * rr - pr * pr
    covariance = np.array([[rr, -pr], [-pr, pp]]) * (variance / area)
    small = max(abs(unknowns[2]), abs(unknowns[3])) < _MOST_TILT_RAD
    definite = pp > 0.0 and area > 0.0
    found = bool(on >= LEAST_DIRECTIONS and small and definite)
    return OutlineTilt(found, unknowns[2:].copy(), covariance)


@kernel()
def _derivative_of_levelling(
    rotation: FloatArray, centre: FloatArray, x: float, y: float
) -> tuple[float, float, float, float]:
    """d(levelled x, y) / d(x, y) of a point on the calibrated floor, row by row."""
    dx, dy, dz = x - centre[0], y - centre[1], -centre[2]
    down = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz
    along = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz
    aside = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz
    height = rotation[2, 0] * centre[0] + rotation[2, 1] * centre[1] + rotation[2, 2] * centre[2]
    scale = -height / down
    return (
        scale * (rotation[0, 0] - along / down * rotation[2, 0]),
        scale * (rotation[0, 1] - along / down * rotation[2, 1]),
        scale * (rotation[1, 0] - aside / down * rotation[2, 0]),
        scale * (rotation[1, 1] - aside / down * rotation[2, 1]),
    )


def mean_of_tilts(tilt: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean of (N, 2) discs' tilts under Student's t distribution, and its covariance."""
    information, mean = np.linalg.inv(covariance), np.median(tilt, axis=0)
    for _ in range(_ITERATIONS):
        off = (tilt - mean)[..., None]
        squared = off.swapaxes(1, 2) @ information @ off
        weighted = (_FREEDOM + 2.0) / (_FREEDOM + squared) * information
        of_mean = np.linalg.inv(weighted.sum(axis=0))
        mean = of_mean @ (weighted @ tilt[..., None]).sum(axis=0)[:, 0]
    return mean, of_mean
