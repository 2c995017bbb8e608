"""The tilt of the frames of a run: a constant lean, and what a frame deviates from it.

One frame's verticals are easily wrong together: trunks, folds of a curtain, a board that leans.
Over a run they tell how the camera leans against its calibration, and how far a single frame is to
be believed. Each axis is an autoregression about a constant, seen through errors that last as long
as their scene is in view (`detect.run_tilt_kernels`); its constants are those of the largest
likelihood.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: With fewer measured frames there is no telling the errors from the tilt.
LEAST_FRAMES = 20
#: The model's constants are learned from no more frames than this, evenly spaced runs of them.
LEARNED_FROM = 4000
#: Prior of the spread of the true tilt about its constant: a robot on an even floor, within e.
_SPREAD_RAD = math.radians(0.3)
_SEARCH = {"maxfev": 3000, "fatol": 1e-4, "xatol": 1e-4, "adaptive": True}
#: Standard deviation of strays: other tilts that the consensus finds (rad).
_STRAY_RAD = math.radians(2.0)
#: What verticals cannot know, however many: what the lens does to all of them alike towards the
#: image's border (rad). It is stated, not learned: a run shows the sum of it and the true lean.
COMMON_RAD = math.radians(0.2)


@dataclass(frozen=True, eq=False)
class AxisModel:
    """What was learned of one axis.

    Attributes
    ----------
    lean, lean_sigma : float
        The constant, and its standard deviation (rad).
    numbers : (7,) float64
        See `detect.run_tilt_kernels.smooth_axis`.
    """

    lean: float
    lean_sigma: float
    numbers: FloatArray


@dataclass(frozen=True, eq=False)
class RunTilt:
    """The tilt of all frames of a run.

    Attributes
    ----------
    axes : (AxisModel, AxisModel)
        Pitch and roll.
    tilt : (N, 2) float64
        Pitch and roll of each frame (rad).
    variance : (N, 2) float64
        Of them (rad^2), the constant's included; the two axes are taken for independent.
    """

    axes: tuple[AxisModel, AxisModel]
    tilt: FloatArray
    variance: FloatArray

    def sentence(self) -> str:
        """The constant lean, and that it was used."""
        pitch, roll = (
            f"{math.degrees(axis.lean):.2f} +- {math.degrees(axis.lean_sigma):.2f}"
            for axis in self.axes
        )
        return (
            f"the camera leans {pitch} (pitch) and {roll} degrees (roll) from its calibration: "
            "levelled by it"
        )


def tilt_of_run(measured: FloatArray, variance: FloatArray) -> RunTilt | None:
    """The tilt of a run's frames from what each of them shows.

    Parameters
    ----------
    measured : (N, 2) float64
        Pitch and roll by the verticals of each frame (rad), in the frames' order; NaN where there
        are none.
    variance : (N, 2) float64
        Of them (rad^2).

    Returns
    -------
    RunTilt or None
        None if fewer than `LEAST_FRAMES` frames have a tilt.
    """
    if np.count_nonzero(np.isfinite(measured[:, 0])) < LEAST_FRAMES:
        return None
    from detect.run_tilt_kernels import smooth_axis

    axes, tilts, variances = [], [], []
    for values, of_values in zip(measured.T, variance.T):
        sigma = np.sqrt(of_values)
        axis = _learned(*_part(values, sigma))
        _, deviation, of_deviation = smooth_axis(values - axis.lean, sigma, axis.numbers)
        axes.append(axis)
        tilts.append(axis.lean + deviation)
        variances.append(of_deviation + axis.lean_sigma**2)
    return RunTilt((axes[0], axes[1]), np.stack(tilts, -1), np.stack(variances, -1))


def _part(values: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Some stretches of a long run, frames without a tilt between them."""
    if len(values) <= LEARNED_FROM:
        return values, sigma
    stretch = LEARNED_FROM // 8
    gap = np.full(50, np.nan)
    starts = np.linspace(0, len(values) - stretch, 8).astype(int)
    return tuple(  # type: ignore[return-value]
        np.concatenate([part for k in starts for part in (array[k : k + stretch], gap)])
        for array in (values, sigma)
    )


def _model(unknowns: FloatArray) -> FloatArray:
    """The kernel's constants from numbers without bounds."""
    _, spread, memory, scale, lasting, noise, share = np.clip(unknowns, -30.0, 30.0).tolist()
    return np.array(
        [
            math.exp(spread),
            0.99 / (1.0 + math.exp(-memory)),
            math.exp(scale),
            0.99 / (1.0 + math.exp(-lasting)),
            math.exp(noise),
            0.001 + 0.4 / (1.0 + math.exp(-share)),
            _STRAY_RAD,
        ]
    )


def _learned(values: FloatArray, sigma: FloatArray) -> AxisModel:
    """The constants of the largest likelihood, and how well the lean among them is known."""
    from scipy.optimize import minimize

    from detect.run_tilt_kernels import smooth_axis

    unit = math.radians(0.1)
    typical = float(np.nanmedian(sigma))

    def cost(unknowns: FloatArray) -> float:
        log_likelihood, _, _ = smooth_axis(values - unit * unknowns[0], sigma, _model(unknowns))
        prior = (
            (unknowns[1] - math.log(_SPREAD_RAD)) ** 2
            + (unknowns[3] / 2.0) ** 2
            + (unknowns[5] - math.log(typical)) ** 2 / 4.0
            + (unknowns[2] ** 2 + unknowns[4] ** 2 + (unknowns[6] + 1.0) ** 2) / 8.0
        )
        return float(0.5 * prior - log_likelihood)

    lean = float(np.nanmedian(values)) / unit
    begin = [
        np.array([lean, math.log(_SPREAD_RAD), 0.5, scale, 0.5, math.log(typical), -1.0])
        for scale in (-1.0, 1.5)
    ]
    found = [minimize(cost, x, method="Nelder-Mead", options=_SEARCH) for x in begin]
    best = min(found, key=lambda result: float(result.fun))
    step = np.zeros(len(best.x))
    step[0] = 0.2
    curvature = (cost(best.x + step) - 2.0 * best.fun + cost(best.x - step)) / (0.2 * unit) ** 2
    own = 1.0 / max(curvature, 1e-6)
    return AxisModel(float(best.x[0]) * unit, math.sqrt(own + COMMON_RAD**2), _model(best.x))
