"""The one tilt and height of the camera that explains where two sets of rows put the same discs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from camera import Camera
from detect.seen import image_positions

FloatArray = NDArray[np.float64]

#: Huber's constant: 95 % efficient where errors are normal.
_HUBER = 1.345
_LEAST_PAIRS = 4
#: With fewer frames, their scatter does not determine the uncertainty of the lean.
_LEAST_FRAMES = 10
_LARGEST_CONDITION = 1e10


@dataclass(frozen=True, slots=True)
class Lean:
    """Pitch, roll and height that turn reference positions into detected ones.

    Attributes
    ----------
    pitch_rad, roll_rad : float
        As those of a tilt (`landmarks.FrameTilt`).
    raised_m : float
        How much higher the camera is.
    sigma : (float, float, float)
        Standard deviations of the three, from how frames differ (errors within a frame may be
        common to its rows).
    """

    pitch_rad: float
    roll_rad: float
    raised_m: float
    sigma: tuple[float, float, float]

    @property
    def tilt(self) -> tuple[float, float]:
        """Pitch and roll, rad."""
        return self.pitch_rad, self.roll_rad


def common_lean(
    camera: Camera,
    reference_xy: FloatArray,
    detected_xy: FloatArray,
    frame: NDArray[np.int64],
) -> Lean | None:
    """Fit the lean to matched rows: robust least squares of their differences in the image.

    There all rows are known about equally well; on the floor, far ones would outweigh all others.

    Parameters
    ----------
    camera : Camera
    reference_xy, detected_xy : (N, 2) float64
        Positions of matched rows, metres.
    frame : (N,) int64
        Which frame each pair is of.

    Returns
    -------
    Lean or None
        None if the rows are too few or do not determine it.
    """
    seen = image_positions(camera, reference_xy)
    usable = np.isfinite(seen).all(axis=1) & np.isfinite(image_positions(camera, detected_xy)).all(
        axis=1
    )
    if usable.sum() < _LEAST_PAIRS:
        return None
    seen, detected_xy, frame = seen[usable], detected_xy[usable], frame[usable]

    def differences(lean: FloatArray) -> FloatArray:
        again = image_positions(camera, detected_xy, (lean[0], lean[1]), lean[2])
        return np.nan_to_num(again - seen, nan=1e3).ravel()

    start = least_squares(differences, np.zeros(3), loss="soft_l1", x_scale=(0.01, 0.01, 0.01))
    scale = _HUBER * max(1.4826 * float(np.median(np.abs(start.fun))), 1e-3)
    found = least_squares(
        differences, start.x, loss="huber", f_scale=scale, x_scale=(0.01, 0.01, 0.01)
    )
    residual = differences(found.x)
    # The solver's Jacobian is scaled by its loss.
    by = np.stack(
        [(differences(found.x + s) - differences(found.x - s)) / 2e-6 for s in 1e-6 * np.eye(3)],
        axis=1,
    )
    weight = np.minimum(1.0, scale / np.maximum(np.abs(residual), 1e-12))
    normal = by.T @ (weight[:, None] * by)
    if not np.linalg.cond(normal) < _LARGEST_CONDITION:
        return None
    inverse = np.linalg.inv(normal)
    _, of = np.unique(frame, return_inverse=True)
    frames = int(of.max()) + 1
    if frames >= _LEAST_FRAMES:
        pull = np.zeros((frames, 3))
        np.add.at(pull, np.repeat(of, 2), (weight * residual)[:, None] * by)
        covariance = inverse @ (pull.T @ pull) @ inverse * frames / (frames - 1)
    else:
        freedom = max(len(residual) - 3, 1)
        covariance = inverse * float((weight * residual**2).sum()) / freedom
    pitch, roll, raised = found.x.tolist()
    sigma_p, sigma_r, sigma_h = np.sqrt(np.diag(covariance)).tolist()
    return Lean(pitch, roll, raised, (sigma_p, sigma_r, sigma_h))
