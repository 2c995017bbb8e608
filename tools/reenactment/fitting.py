"""Least squares over a recorded run: poses, discs, the camera's true mounting, the robot's tilt.

The solver is that of `slam map` (`redetect.slam.mapping`); what a tilted, differently mounted
camera makes of discs is `tools.reenactment.mounted_discs`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from camera import Camera
from redetect.landmarks import wrap_angle
from redetect.least_squares.solver import whitening
from redetect.plane import between
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.mapping.graph_terms import Weighting as SlamWeighting
from redetect.slam.mapping.solve import solve
from tools.arrays import BoolArray, FloatArray, IntArray
from tools.reenactment.mounted_discs import Geometry, predict_pixels
from tools.reenactment.recording import Recording


class RefitError(ValueError):
    """A fit that cannot begin, or does not settle."""


@dataclass(frozen=True)
class Weighting:
    """What counts as an error, and how much."""

    metric: Literal["floor", "pixel"] = "floor"
    """Rows are compared on the floor under their shipped covariance, or under that of a pixel."""
    pixel_sigma: float = 1.0  # Standard deviation of a row in the image, pixels; "pixel" only.
    robust_scale: float | None = None
    """Errors well past this many standard deviations lose their pull (Geman-McClure), and discs may
    be out of sight; None: least squares."""
    odometry_scale: float = 1.0  # Factor on the odometry's standard deviations.
    mounting: bool = True  # Whether the camera's rotation and height are unknowns.
    tilt_sigma: float = 0.0  # Of a frame's pitch and roll, radians; 0: the robot doesn't tilt.


@dataclass(frozen=True, eq=False)
class Fit:
    """A geometry that a fit ended at, and its sum of (robust) squared errors."""

    geometry: Geometry
    cost: float


def nominal_geometry(camera: Camera, poses: FloatArray, disc_xy: FloatArray) -> Geometry:
    """The geometry with the camera mounted as calibrated and the robot upright."""
    return Geometry(
        poses=poses,
        disc_xy=disc_xy,
        rotation=np.array(camera.rotation),
        centre=np.array(camera.centre),
        tilt=np.zeros((len(poses), 2)),
    )


def odometry_residuals(poses: FloatArray, steps: FloatArray) -> FloatArray:
    """(N, 3) relative motions of poses, from the start (0, 0, 0) on, minus steps."""
    path = np.concatenate([np.zeros((1, 3)), poses])
    residuals = between(path[:-1], path[1:]) - steps
    residuals[:, 2] = wrap_angle(residuals[:, 2])
    return residuals


def mahalanobis(
    camera: Camera, pixels: FloatArray, row_xy: FloatArray, row_covariance: FloatArray
) -> FloatArray:
    """How far pixels, put on the floor by the calibrated camera, are from rows.

    In standard deviations; infinite where a disc is out of sight (a pixel is NaN).
    """
    error = camera.floor_from_pixel(pixels) - row_xy
    whitened = np.linalg.solve(np.linalg.cholesky(row_covariance), error[..., None])
    distance = np.linalg.norm(whitened[..., 0], axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def row_distances(camera: Camera, recording: Recording, geometry: Geometry) -> FloatArray:
    """(n,) Mahalanobis distances of the rows that a geometry predicts from the recorded ones."""
    pixels, _ = predict_pixels(camera, geometry, recording.frame, recording.disc)
    return mahalanobis(camera, pixels, recording.row_xy, recording.row_covariance)


def refit(
    camera: Camera,
    recording: Recording,
    start: Geometry,
    weighting: Weighting,
    *,
    tolerance: float = 1e-9,
    max_steps: int = 300,
) -> Fit:
    """Fit a geometry to a recording, until a step lowers the cost by less than `tolerance` of it.

    Raises
    ------
    RefitError
        If least squares starts with a disc out of its camera's sight, or the steps run out.
    """
    seen = np.isfinite(row_distances(camera, recording, start))
    if weighting.robust_scale is None and not seen.all():
        raise RefitError(
            "the start has discs where the camera can't see them: expected a robust fit before"
        )
    # Rows out of sight pull nothing, and discs of no other rows stay where they are.
    discs, index = np.unique(recording.disc[seen], return_inverse=True)
    graph = _graph(camera, recording, weighting, seen, discs, index.astype(np.int64))
    estimate = Estimate(
        poses=np.concatenate([np.zeros((1, 3)), start.poses]),
        disc_xy=start.disc_xy[discs],
        line_xy=np.zeros((0, 2)),
        mounting=np.column_stack([start.rotation, start.centre]) if weighting.mounting else None,
        tilt=np.concatenate([np.zeros((1, 2)), start.tilt]) if weighting.tilt_sigma else None,
    )
    function = SlamWeighting(
        loss="none" if weighting.robust_scale is None else "geman-mcclure",
        loss_scale=weighting.robust_scale or 1.0,
        calibrate=weighting.mounting,
        row_errors="recorded",
        tilt_sigma_rad=weighting.tilt_sigma,
    )
    try:
        found = solve(graph, estimate, function, tolerance=tolerance, most_steps=max_steps)
    except SlamError as error:
        raise RefitError(str(error)) from None
    disc_xy = start.disc_xy.copy()
    disc_xy[discs] = found.estimate.disc_xy
    after = replace(start, poses=found.estimate.poses[1:], disc_xy=disc_xy)
    if found.estimate.mounting is not None:
        mounting = found.estimate.mounting
        after = replace(after, rotation=mounting[:, :3], centre=mounting[:, 3])
    if found.estimate.tilt is not None:
        after = replace(after, tilt=found.estimate.tilt[1:])
    return Fit(after, found.cost)


def _graph(
    camera: Camera, recording: Recording, weighting: Weighting, rows: BoolArray,
    discs: IntArray, index: IntArray,
) -> Graph:  # fmt: skip
    """The measurements of some rows as the solver takes them."""
    covariance = recording.row_covariance[rows]
    if weighting.metric == "pixel":
        jacobian = camera.floor_jacobian(recording.pixels[rows])
        covariance = weighting.pixel_sigma**2 * jacobian @ np.swapaxes(jacobian, 1, 2)
    no_integers, no_numbers = np.zeros(0, dtype=np.int64), np.zeros(0)
    return Graph(
        steps=recording.steps,
        step_whitening=whitening(recording.step_covariance) / weighting.odometry_scale,
        disc_ids=recording.disc_ids[discs],
        disc_pose=recording.frame[rows] + 1,
        disc_index=index,
        disc_xy=recording.row_xy[rows],
        disc_whitening=whitening(covariance),
        line_ids=no_integers,
        line_pose=no_integers,
        bearing_rad=no_numbers,
        bearing_sigma_rad=no_numbers,
        member_row=no_integers,
        member_line=no_integers,
        camera_xy=np.array(camera.centre[:2]),
        camera=camera,
    )
