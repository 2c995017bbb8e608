"""Uncertainty of a calibration due to terms of the lens that are not free in its fit.

Pictures that do not reach the image's corners, or few pictures, do not show all terms of a lens.
The fit without a term is as good there, and its covariance is that of the other terms alone: it
would be far too small where the distortion is extrapolated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from camera.calibration.adjustment import Adjusted, Points, with_terms
from camera.calibration.model import (
    INTRINSICS,
    POLYNOMIAL,
    TANGENTIAL,
    CalibrationSettings,
    FreeLens,
    corner_radius,
    lens_of,
)
from camera.distortion import one_to_one_radius, straightened
from redetect.array_types import FloatArray

# Standard deviation of what a term that is not free does in the farthest corner: a share of the
# fitted distortion, and a part of the radius. Terms that do more are seen in most pictures.
_SHARE = 0.15
_LEAST = 0.003
# Standard deviation of p1 and p2: lenses are decentred by this much unnoticed.
_TANGENTIAL_SIGMA = 5e-4


def with_unfitted_terms(
    fit: Adjusted, points: Points, lens: FreeLens, settings: CalibrationSettings
) -> Adjusted:
    """A fit whose covariance includes the terms that its lens leaves out.

    These are the powers of the radius from the first one that the lens does not have to the sixth,
    and p1 and p2. Terms that the settings exclude are taken to be 0.
    """
    names, sigmas = [], []
    if settings.coefficients is None:
        corner, distortion = _corner(fit.estimate.intrinsics, points)
        effect = _SHARE * abs(distortion) + _LEAST
        # a3 and a3 b2 are r^2 and r^4; more rational terms do not span r^6.
        first = max(lens.polynomial, min(lens.coefficients, len(POLYNOMIAL) - 1))
        for power, name in list(enumerate(POLYNOMIAL, start=1))[first:]:
            names.append(name)
            sigmas.append(effect / corner ** (2 * power))
    if settings.tangential is None and not lens.tangential:
        names += TANGENTIAL
        sigmas += [_TANGENTIAL_SIGMA] * len(TANGENTIAL)
    if not names:
        return fit
    terms = np.eye(len(INTRINSICS))[:, [INTRINSICS.index(name) for name in names]]
    covariance = with_terms(fit, points, lens.span(settings.aspect), terms, np.array(sigmas))
    return replace(fit, covariance=covariance)


def _corner(intrinsics: FloatArray, points: Points) -> tuple[float, float]:
    """Undistorted normalised radius of the farthest corner, and its relative distortion there."""
    seen = corner_radius(intrinsics, points.width, points.height)
    coef, (k1, k2, _, _, k3) = lens_of(intrinsics)
    brown = (k1, k2, 0.0, 0.0, k3)
    place = np.array([[seen, 0.0]])
    there = float(straightened(place, coef, brown, one_to_one_radius(coef, brown))[0, 0])
    # Beyond the fold, if decentring alone moves the corner to before it.
    return (there, seen / there - 1.0) if np.isfinite(there) else (seen, 1.0)
