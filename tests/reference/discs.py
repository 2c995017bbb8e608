"""The fit of a disc, stage by stage, written to be read: the reference of the compiled stages.

Double precision, NumPy and SciPy; nothing here is in a hurry.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import chndtr, ndtr

from detect.discs.model import BEND, T_LIMIT, Z_LIMIT
from detect.discs.patch import Candidate, Reach
from redetect.array_types import FloatArray, IntArray

PIXEL_VARIANCE = 1.0 / 12.0


@dataclass(frozen=True)
class Pixels:
    """Pixels of a patch: places on the floor, in radii, and steps along two axes of the image."""

    x: FloatArray
    y: FloatArray
    x1: FloatArray
    y1: FloatArray
    x2: FloatArray
    y2: FloatArray
    growth: float = 0.0


# -- the model ----------------------------------------------------------------------------------


def share_of_a_round_blur(distance: FloatArray, sigma: FloatArray) -> FloatArray:
    """Share of a unit disc under a round Gaussian: a noncentral chi-square distribution."""
    return np.asarray(chndtr(1.0 / sigma**2, 2, (distance / sigma) ** 2))


def share_of_an_ellipse(
    half_u: float, half_v: float, blur_u: float, blur_v: float, u: FloatArray, v: FloatArray
) -> FloatArray:
    """What pixels at (u, v) from its centre see of an ellipse blurred by Gaussian and pixel.

    A sum over chords along v: their weights depend on a pixel's u only, what it sees of them on
    its v only, so each is computed once for every u and every v that occurs.
    """
    step = 1.0 / 32.0
    fine = np.arange(-half_u - step, half_u + step, step) + 0.5 * step
    half = half_v * np.sqrt(np.maximum(1.0 - (fine / half_u) ** 2, 0.0))
    box = (np.arange(16) + 0.5) / 16.0 - 0.5
    each_u, of_u = np.unique(u, return_inverse=True)
    each_v, of_v = np.unique(v, return_inverse=True)
    across = fine - each_u[:, None]
    weights = ndtr((across + 0.5) / blur_u) - ndtr((across - 0.5) / blur_u)
    rows = each_v[:, None, None] + box[:, None]
    chords = ndtr((half - rows) / blur_v) - ndtr((-half - rows) / blur_v)
    share = step * weights @ chords.mean(axis=1).T
    return np.asarray(share[of_u.reshape(u.shape), of_v.reshape(v.shape)])


def edge_share(
    at: Pixels, x: float, y: float, radius: float, blur_1: float, blur_2: float
) -> FloatArray:
    """W by the profile of a curved edge."""
    # At the centre itself any direction will do.
    dx, dy = at.x - x + 1e-9, at.y - y
    r = np.hypot(dx, dy)
    nx, ny = dx / r, dy / r
    variance_1, variance_2 = blur_1**2 + PIXEL_VARIANCE, blur_2**2 + PIXEL_VARIANCE
    across = np.sqrt(
        variance_1 * (at.x1 * nx + at.y1 * ny) ** 2 + variance_2 * (at.x2 * nx + at.y2 * ny) ** 2
    )
    area = (at.x1 * at.y2 - at.x2 * at.y1) ** 2 * variance_1 * variance_2
    t = np.minimum(area / across**3 / radius, T_LIMIT)
    z = np.clip((r - radius) / across, (Z_LIMIT - 1.0 / T_LIMIT) / T_LIMIT * t - Z_LIMIT, Z_LIMIT)
    q = sum(c * z**i * t**j for i, row in enumerate(BEND) for j, c in enumerate(row))
    return np.asarray(ndtr(-(z + t * (0.5 + t * q))))


def chord_share(
    at: Pixels, x: float, y: float, radius: float, blur_1: float, blur_2: float
) -> FloatArray:
    """W by the chords along the first axis, the integral across them a sum over 400 of them."""
    length = np.hypot(at.x1, at.y1)
    n1, n2 = at.x1 / length, at.y1 / length
    dx, dy = at.x - x, at.y - y
    along, across = (dx * n1 + dy * n2) / length, dy * n1 - dx * n2
    step = at.y2 * n1 - at.x2 * n2
    slant = -(at.x2 * n1 + at.y2 * n2) / length / step
    reach = np.abs(step) * math.sqrt(7.0 * (blur_2**2 + PIXEL_VARIANCE))
    first = np.arcsin(np.clip((across - reach) / radius, -1.0, 1.0))
    last = np.arcsin(np.clip((across + reach) / radius, -1.0, 1.0))
    theta = first + (np.arange(400)[:, None] + 0.5) / 400 * (last - first)
    half = radius * np.cos(theta)
    off = radius * np.sin(theta) - across
    ends = []
    for sign in (1.0, -1.0):
        d = off * slant - along + sign * half / length
        bend = np.clip(at.growth * d, -0.7, 0.7)
        ends.append(ndtr(d * (1.0 - 0.5 * bend) / math.sqrt(blur_1**2 + PIXEL_VARIANCE)))
    kernel = 15.0 / 16.0 * (1.0 - (off / reach) ** 2) ** 2 / reach
    return np.asarray(np.sum(kernel * (ends[0] - ends[1]) * half, axis=0) * (last - first) / 400)


# -- the patch ----------------------------------------------------------------------------------


def pixels_within_reach(
    floor_xy: NDArray[np.float32], candidate: Candidate, reach: Reach, blur_ratio: float
) -> IntArray:
    """(N,) flat indices of all pixels to which a disc at the candidate is fitted."""
    floor = floor_xy.astype(float)
    u, v = candidate.u, candidate.v
    by_u = (floor[v, u + 1] - floor[v, u - 1]) / 2.0 / candidate.radius
    by_v = (floor[v + 1, u] - floor[v - 1, u]) / 2.0 / candidate.radius
    place = (floor - floor[v, u]) / candidate.radius
    r = np.linalg.norm(place, axis=-1)
    off = np.abs(r - 1.0) * r
    blur_u, blur_v = candidate.blur, candidate.blur * blur_ratio
    with np.errstate(invalid="ignore"):
        per_u, per_v = place @ by_u, place @ by_v
        within = r <= reach.radii
        within |= off <= reach.px * np.hypot(per_u, per_v)
        within |= off <= reach.blurs * np.hypot(blur_u * per_u, blur_v * per_v)
        within &= (r >= reach.nearest) & (r <= reach.farthest)
    within[[0, -1]] = within[:, [0, -1]] = False
    return np.flatnonzero(within)


# -- the fit ------------------------------------------------------------------------------------


def background_of(at: Pixels) -> FloatArray:
    """(5, N) terms of the background."""
    return np.stack([np.ones_like(at.x), at.x, at.y, at.x**2 - at.y**2, at.x * at.y])


@dataclass(frozen=True)
class Expected:
    """What is expected of a disc before it is fitted."""

    noise: float  # grey levels
    radius_sigma: float  # relative, about the nominal one
    blur_px: tuple[float, float]  # along either axis of the pixels
    blur_sigma: float  # of its logarithm


def fitted_disc(at: Pixels, grey: FloatArray, flat: bool, expected: Expected) -> FloatArray:
    """x, y, radius and logarithms of both blurs of the disc that explains the grey values best."""
    share_of = chord_share if flat else edge_share
    usual = np.log(expected.blur_px)

    def misfit(p: FloatArray) -> FloatArray:
        share = share_of(at, p[0], p[1], p[2], *np.exp(p[3:]))
        terms = np.vstack([background_of(at), share])
        linear = np.linalg.lstsq(terms.T, grey, rcond=None)[0]
        beforehand = [
            (p[2] - 1.0) / expected.radius_sigma,
            *((p[3:] - usual) / expected.blur_sigma),
        ]
        return np.append((grey - terms.T @ linear) / expected.noise, beforehand)

    start = np.array([0.0, 0.0, 1.0, *usual])
    return np.asarray(least_squares(misfit, start, x_scale=[0.1, 0.1, 0.1, 0.5, 0.5]).x)
