"""Phase 2, second part: rough corners of a region.

RAWSEEDS deliverable D2.1 part 2 has two algorithms. A takes the local maxima of the distance from
the barycentre, and needs exactly four. B takes the quadrangle of largest area in the perimeter, by
coordinate ascent with a decaying random perturbation.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.settings import CornerAlgorithm

FloatArray = NDArray[np.float64]

#: Causes of rejection, as they are counted.
NOT_FOUR_CORNERS = "not four corners"
NO_QUADRANGLE = "no quadrangle"

_SEED = 20061
#: Algorithm A: corners are this far apart as seen from the barycentre.
_CORNER_SPACING_RAD = math.radians(25.0)
#: Algorithm A: distance of the points along the perimeter, in perimeters.
_CHAIN_STEP = 1.0 / 160.0
#: Quadrangles whose corners are all this near (pixels, and in widths) are one and the same.
_SAME_PX, _SAME_WIDTHS = 1.0, 0.08
_PERTURBATIONS = 12
_DECAY = 0.75
_LCG_FACTOR = 1103515245
_LCG_STEP = 12345
_LCG_MODULUS = 1 << 31


def rough_corners(hull: FloatArray, algorithm: CornerAlgorithm) -> FloatArray | None:
    """Four corners of a region.

    Parameters
    ----------
    hull : (N, 2) float64
        The region's convex hull.
    algorithm : "A" or "B"
        See the module.

    Returns
    -------
    (4, 2) float64, or None
        Top left, top right, bottom right, bottom left up to a rotation (clockwise as seen in the
        image); None if there are not exactly four.
    """
    if len(hull) < 4:
        return None
    if algorithm == "B":
        corners = hull[largest_quadrangle(hull, _SEED)]
    else:
        chain = _dense_chain(hull)
        index = _farthest_corners(chain, _CORNER_SPACING_RAD)
        if len(index) != 4:
            return None
        corners = chain[index]
    return np.ascontiguousarray(corners if signed_area(corners) > 0.0 else corners[::-1])


def _dense_chain(hull: FloatArray) -> FloatArray:
    """Points at equal distances along a closed polygon."""
    closed = np.concatenate([hull, hull[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    at = np.arange(0.0, 1.0 - 0.5 * _CHAIN_STEP, _CHAIN_STEP) * along[-1]
    # The corners themselves stay: the farthest points are among them.
    at = np.unique(np.concatenate([at, along[:-1]]))
    return np.stack([np.interp(at, along, closed[:, k]) for k in range(2)], axis=-1)


@njit(cache=True, error_model="numpy")
def _twice_area(points: FloatArray, index: NDArray[np.int64]) -> float:
    total = 0.0
    for k in range(4):
        a = index[k]
        b = index[(k + 1) % 4]
        total += points[a, 0] * points[b, 1] - points[b, 0] * points[a, 1]
    return abs(total)


@njit(cache=True, error_model="numpy")
def _ascend(points: FloatArray, index: NDArray[np.int64]) -> float:
    """Move one corner at a time to the best place between its neighbours until none gains."""
    n = len(points)
    best = _twice_area(points, index)
    for _ in range(4 * n):
        gained = False
        for k in range(4):
            before = index[(k + 3) % 4]
            after = index[(k + 1) % 4]
            span = (after - before) % n
            # The triangle over the chord between the neighbours.
            cx = points[after, 0] - points[before, 0]
            cy = points[after, 1] - points[before, 1]
            largest = -1.0
            at = index[k]
            for step in range(1, span):
                j = (before + step) % n
                height = abs(
                    cx * (points[j, 1] - points[before, 1])
                    - cy * (points[j, 0] - points[before, 0])
                )
                if height > largest:
                    largest = height
                    at = j
            if at != index[k]:
                old = index[k]
                index[k] = at
                area = _twice_area(points, index)
                if area > best * (1.0 + 1e-12):
                    best = area
                    gained = True
                else:
                    index[k] = old
        if not gained:
            break
    return best


@njit(cache=True, error_model="numpy")
def largest_quadrangle(points: FloatArray, seed: int) -> NDArray[np.int64]:
    """Indices of the quadrangle of largest area in a closed chain of points.

    Algorithm B: coordinate ascent, started anew from the best one with its indices perturbed at
    random, ever less.

    Parameters
    ----------
    points : (N, 2) float64
        The chain, N >= 4.
    seed : int
        Of the perturbations.

    Returns
    -------
    (4,) int64
        In the order of the chain.
    """
    n = len(points)
    best = np.empty(4, np.int64)
    for k in range(4):
        best[k] = k * n // 4
    area = _ascend(points, best)
    amplitude = n / 4.0
    state = seed % _LCG_MODULUS
    trial = np.empty(4, np.int64)
    for _ in range(_PERTURBATIONS):
        for k in range(4):
            state = (_LCG_FACTOR * state + _LCG_STEP) % _LCG_MODULUS
            shift = (2.0 * state / _LCG_MODULUS - 1.0) * amplitude
            trial[k] = (best[k] + round(shift)) % n
        trial.sort()
        if np.all(trial[1:] != trial[:3]):
            found = _ascend(points, trial)
            if found > area * (1.0 + 1e-12):
                area = found
                best[:] = trial
        amplitude *= _DECAY
    best.sort()
    return best


@njit(cache=True, error_model="numpy")
def _farthest_corners(points: FloatArray, spacing: float) -> NDArray[np.int64]:
    """Algorithm A: which points (M,) of a closed chain are farthest from its barycentre.

    That is, of all whose direction from there differs by less than `spacing` radians. The chain is
    so dense that its mean is the barycentre of the outline.
    """
    n = len(points)
    cx = points[:, 0].mean()
    cy = points[:, 1].mean()
    distance = np.empty(n)
    angle = np.empty(n)
    for k in range(n):
        distance[k] = math.hypot(points[k, 0] - cx, points[k, 1] - cy)
        angle[k] = math.atan2(points[k, 1] - cy, points[k, 0] - cx)
    found = np.empty(n, np.int64)
    count = 0
    for k in range(n):
        highest = True
        for j in range(n):
            if j == k:
                continue
            apart = abs(angle[j] - angle[k])
            apart = min(apart, 2.0 * math.pi - apart)
            if apart < spacing and (
                distance[j] > distance[k] or (distance[j] == distance[k] and j < k)
            ):
                highest = False
                break
        if highest:
            found[count] = k
            count += 1
    return found[:count].copy()


@njit(cache=True, error_model="numpy")
def signed_area(polygon: FloatArray) -> float:
    """Area of a polygon (N, 2); positive if it is clockwise as seen in the image (v down)."""
    total = 0.0
    n = len(polygon)
    for k in range(n):
        j = k + 1 if k + 1 < n else 0
        total += polygon[k, 0] * polygon[j, 1] - polygon[j, 0] * polygon[k, 1]
    return 0.5 * total


@njit(cache=True, error_model="numpy")
def is_convex(corners: FloatArray) -> bool:
    """Whether a clockwise quadrangle (4, 2) is strictly convex."""
    for k in range(4):
        a, b, c = corners[k], corners[(k + 1) % 4], corners[(k + 2) % 4]
        if not (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]) > 0.0:
            return False
    return True


@njit(cache=True, error_model="numpy")
def same_corners(
    first: FloatArray, second: FloatArray, apart_px: float, apart_widths: float
) -> bool:
    """Whether each corner of a quadrangle is near some corner of another."""
    limit = apart_px + apart_widths * math.sqrt(abs(signed_area(second)))
    for k in range(4):
        least = math.inf
        for j in range(4):
            apart = max(abs(first[k, 0] - second[j, 0]), abs(first[k, 1] - second[j, 1]))
            least = min(least, apart)
        if least > limit:
            return False
    return True


@njit(cache=True, error_model="numpy")
def count_same(first: FloatArray, others: FloatArray) -> int:
    """How many of (N, 4, 2) quadrangles have the same corners as one, in any order."""
    total = 0
    for n in range(len(others)):
        if same_corners(first, others[n], _SAME_PX, _SAME_WIDTHS):
            total += 1
    return total


@njit(cache=True, error_model="numpy")
def overlap(first: FloatArray, second: FloatArray) -> bool:
    """Whether the middle of either clockwise convex quadrangle (4, 2) is inside the other."""
    return _middle_inside(first, second) or _middle_inside(second, first)


@njit(cache=True, error_model="numpy")
def _middle_inside(first: FloatArray, second: FloatArray) -> bool:
    x, y = first[:, 0].mean(), first[:, 1].mean()
    for k in range(4):
        a, b = second[k], second[(k + 1) % 4]
        if not (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) > 0.0:
            return False
    return True
