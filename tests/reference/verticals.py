"""What the stages of the detector of verticals compute, written to be read (NumPy and SciPy).

Tests hold the compiled stages to these.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d, map_coordinates
from scipy.special import logsumexp, softmax

from detect.line_settings import LineSettings
from detect.verticals.tilt import TiltEstimate, levelling_rotation
from lut.verticals import VerticalTable
from redetect.array_types import FloatArray, IntArray

# -- response --------------------------------------------------------------------------------------


def response(image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings) -> FloatArray:
    """Signed squared correlation of grey value and distance across verticals.

    With Gaussian weights g and h = x / (weighted standard deviation of x) this is
    Cov_g(h, I) |Cov_g(h, I)| / (Var_g(I) + regulariser): moments across rows of the image, taken
    where verticals cross them, and summed up along the verticals as far as these are seen.

    Returns
    -------
    (H, W) float64
        In the strip; 0 where the window leaves the image.
    """
    x, across = _gaussian(settings.sigma_across_px)
    lever = across * x / math.sqrt(across @ x**2)
    _, along = _gaussian(settings.sigma_along_rows)
    # Where windows leave the image, it counts as of middle grey.
    grey = image.astype(np.float64) - 128.0
    height, width = image.shape
    row = np.broadcast_to(np.arange(height)[:, None], (height, width))
    r = len(x) // 2
    with np.errstate(invalid="ignore"):
        inside = (table.column >= r) & (table.column < width - 1 - r)
    seen = np.isfinite(table.column)
    place = [row, np.where(inside, table.column, 0.0)]
    mean, cov, square = (
        np.where(inside, map_coordinates(moment, place, order=1), 0.0)
        for moment in (
            correlate1d(grey, across, axis=1),
            correlate1d(grey, lever, axis=1),
            correlate1d(grey**2, across, axis=1),
        )
    )
    share, mean, cov, square = (
        correlate1d(moment.astype(np.float64), along, axis=0, mode="constant")
        for moment in (seen, mean, cov, square)
    )
    share = np.where(seen, share, 1.0)
    variance = square / share - (mean / share) ** 2
    value = np.sign(cov) * (cov / share) ** 2 / (np.abs(variance) + settings.regulariser)
    return np.where(inside, value, 0.0)


def _gaussian(sigma: float) -> tuple[FloatArray, FloatArray]:
    """Whole pixels within three standard deviations, and weights of sum 1 there."""
    reach = math.ceil(3.0 * sigma)
    x = np.arange(-reach, reach + 1.0)
    weight = np.exp(-0.5 * (x / sigma) ** 2)
    return x, weight / weight.sum()


# -- tracking --------------------------------------------------------------------------------------


def follow(
    response: FloatArray, row: int, column: int, settings: LineSettings
) -> list[tuple[int, float, float]]:
    """Follow an edge through a start up and down, wherever it goes.

    Three neighbouring columns round the last place, moved by one if the highest is not in the
    middle; a parabola through them; at most a column aside from row to row, and
    `settings.gap_rows` rows without a point.

    Returns
    -------
    list of (int, float, float)
        Rows, columns and absolute responses of the points, from top to bottom.
    """
    signed = np.sign(response[row, column]) * response
    halves: list[list[tuple[int, float, float]]] = []
    for direction in (-1, 1):
        place = float(column) if direction < 0 or not halves[0] else halves[0][0][1]
        points: list[tuple[int, float, float]] = []
        v, gap = row, 0
        while gap <= settings.gap_rows:
            border = settings.border_rows
            j = math.floor(place + 0.5)
            if points and not border <= v <= len(response) - 1 - border:
                break
            if not 2 <= j <= response.shape[1] - 3:
                break
            top = j - 1 + int(np.argmax(signed[v, j - 1 : j + 2]))
            left, here, right = signed[v, top - 1 : top + 2]
            found = None
            if here >= settings.threshold and here >= left and here >= right:
                bend = left - 2.0 * here + right
                found = top + (0.5 * (left - right) / bend if bend < 0.0 else 0.0)
            if found is not None and (not points or abs(found - place) <= 1.0):
                points.append((v, found, float(here)))
                place, gap = found, 0
            elif not points:
                break
            else:
                gap += 1
            v += direction
        halves.append(points)
    up, down = halves
    return [*up[::-1], *down[1:]]


# -- lines -----------------------------------------------------------------------------------------


def eigenline(bearing_rad: FloatArray, rise: FloatArray, origin_rad: float) -> FloatArray:
    """a, b of X = a + b Z through points, by the eigen-decomposition of their scatter.

    Parameters
    ----------
    bearing_rad, rise : (N,) float64
        Bearings of the points, and tangents of their elevations.
    origin_rad : float
        Bearing of the chart's origin: X = tan(bearing - origin), Z = rise / cos(bearing - origin).
    """
    off = bearing_rad - origin_rad
    points = np.stack([np.tan(off), rise / np.cos(off)])
    x, z = points.mean(axis=1)
    _, vectors = np.linalg.eigh(np.cov(points, bias=True))
    b = vectors[0, 1] / vectors[1, 1]
    return np.array([x - b * z, b])


def newton_step(
    image: NDArray[np.uint8], row: NDArray[np.int32], column: FloatArray, by: FloatArray,
    sigma: float, half: int, sign: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """A Newton step of a line's a, b towards the steepest grey values, and their covariance.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    row, column : (N,) int32, float64
        Where the line crosses its rows; `column` NaN for none.
    by : (N, 2) float64
        Derivatives of the columns by a and b.
    sigma, half : float, int
        Width of the Gaussian; half the number of pixels that count.
    sign : float
        1 where the image is brighter on the right, else -1.

    Returns
    -------
    change : (2,) float64
        To the maximum of the sum over the rows of H (`detect.verticals.refinement`).
    covariance : (2, 2) float64
        Sandwich of the inverse Hessian and the rows' own gradients, for two fitted parameters.
    """
    gradients, hessian = [], np.zeros((2, 2))
    for v, u, direction in zip(row, column, by):
        if not half < u < image.shape[1] - 1 - half:
            continue
        pixels = int(u) + np.arange(-half + 1, half + 1)
        d = pixels - u
        q = (d / sigma) ** 2
        first, second = (q - 1.0) * np.exp(-q / 2.0), (q - 3.0) * d / sigma**2 * np.exp(-q / 2.0)
        grey = sign * image[v, pixels].astype(np.float64)
        gradients.append((first - first.mean()) @ grey * direction)
        hessian += (second - second.mean()) @ grey * np.outer(direction, direction)
    each = np.array(gradients)
    inverse = np.linalg.inv(hessian)
    scale = len(each) / (len(each) - 2.0)
    return -inverse @ each.sum(axis=0), scale * inverse @ (each.T @ each) @ inverse


# -- bearings --------------------------------------------------------------------------------------


def tilt_error(
    normal: FloatArray,
    variance: FloatArray,
    weight: FloatArray,
    edge: IntArray,
    tilt: tuple[float, float],
    prior: float,
    stray_share: float,
) -> FloatArray:
    """(2, 2) mean square error of a tilt over the posterior of `detect.verticals.tilt`.

    Summed over an even grid of 0.05 degrees, seven degrees to all sides.
    """
    from detect.verticals.tilt import SCATTER_RAD, SCATTER_SHARE, STRAY_RAD, TOGETHER_RAD

    def merged(label: IntArray) -> list[tuple[FloatArray, float]]:
        found = []
        for one in np.unique(label):
            own = label == one
            share = 1.0 / (variance[own] + SCATTER_RAD[1] ** 2)
            share /= share.sum()
            found.append((share @ normal[own], float(share**2 @ variance[own])))
        return found

    bearing = np.arctan2(normal[:, 1], normal[:, 0])
    group = np.full(len(bearing), -1)
    for k in np.argsort(-weight, kind="stable"):
        if group[k] < 0:
            group[(group < 0) & (np.abs(bearing - bearing[k]) < TOGETHER_RAD)] = k
    steps = np.radians(np.arange(-7.0, 7.0001, 0.05))
    pitch, roll = np.meshgrid(tilt[0] + steps, tilt[1] + steps, indexing="ij")
    before = -0.5 * (pitch**2 + roll**2) / prior**2

    def log_posterior(lines: list[tuple[FloatArray, float]], scatter: float) -> FloatArray:
        total = before
        for (x, y, z), own in lines:
            off = z + pitch * y - roll * x
            spread = 3.0 * (own + scatter**2)
            student = 2.0 / (math.pi * math.sqrt(spread)) / (1.0 + off**2 / spread) ** 2
            stray = 1.0 / (math.pi * STRAY_RAD) / (1.0 + (off / STRAY_RAD) ** 2)
            total = total + np.log((1.0 - stray_share) * student + stray_share * stray)
        return np.asarray(total)

    deviation = np.stack([pitch - tilt[0], roll - tilt[1]], axis=-1)
    shares, errors = [], []
    for scatter in SCATTER_RAD:
        shares.append(logsumexp(log_posterior(merged(edge), scatter)))
        density = softmax(log_posterior(merged(group), scatter))
        errors.append(np.einsum("ij,ijk,ijl->kl", density, deviation, deviation))
    return np.asarray(np.tensordot(softmax(np.log(SCATTER_SHARE) + shares), errors, 1))


def plane_normals(ends: ArrayLike, robot_from_camera: ArrayLike) -> FloatArray:
    """Unit normals of the planes through the camera's centre and lines.

    Parameters
    ----------
    ends : (..., 4) array_like
        xtop, ytop, xbottom, ybottom: undistorted normalised coordinates of both ends.
    robot_from_camera : (3, 3) array_like
        Rotation camera -> robot.

    Returns
    -------
    (..., 3) float64
        Robot frame. That of a vertical straight ahead points left.
    """
    xy = np.asarray(ends, dtype=np.float64)
    one = np.ones_like(xy[..., :1])
    rotation = np.asarray(robot_from_camera, dtype=np.float64)
    top = np.concatenate([xy[..., :2], one], axis=-1) @ rotation.T
    bottom = np.concatenate([xy[..., 2:], one], axis=-1) @ rotation.T
    normal = np.cross(top, bottom)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def inclinations(normal: ArrayLike) -> FloatArray:
    """(...) beta of (..., 3) unit normals (rad), before any compensation."""
    return np.asarray(np.arcsin(np.clip(np.asarray(normal, dtype=np.float64)[..., 2], -1.0, 1.0)))


def level_bearings(normal: ArrayLike, pitch_rad: float, roll_rad: float) -> FloatArray:
    """Bearings of the horizontal directions in planes, after turning them level.

    Parameters
    ----------
    normal : (..., 3) array_like
        Unit normals as `plane_normals` gives them.
    pitch_rad, roll_rad : float
        The tilt (see `detect.verticals.tilt`).

    Returns
    -------
    (...) float64
        alpha (rad), 0 forward, positive to the left.
    """
    turned = np.asarray(normal, dtype=np.float64) @ levelling_rotation(pitch_rad, roll_rad).T
    # Of the plane's two level directions (n_y, -n_x) is the one ahead of the camera.
    return np.asarray(np.arctan2(turned[..., 1], turned[..., 0]))


def compensated_bearings(
    normal: ArrayLike, tilt: TiltEstimate | None, *, published: bool = False
) -> FloatArray:
    """Bearings of lines, compensated for the tilt of their frame.

    Parameters
    ----------
    normal : (..., 3) array_like
        Unit normals as `plane_normals` gives them.
    tilt : TiltEstimate or None
        None compensates nothing.
    published : bool
        Turn the other way, as the data set's own rows are.

    Returns
    -------
    (...) float64
        alpha (rad).
    """
    if tilt is None:
        return level_bearings(normal, 0.0, 0.0)
    sign = -1.0 if published else 1.0
    return level_bearings(normal, sign * tilt.pitch_rad, sign * tilt.roll_rad)


def join_bearings(
    alpha_rad: ArrayLike, sigma_rad: ArrayLike, weight: ArrayLike
) -> tuple[float, float]:
    """Mean and standard deviation of a mixture of Gaussians of bearings (rad)."""
    alpha, sigma, share = (np.asarray(v, np.float64) for v in (alpha_rad, sigma_rad, weight))
    share = share / share.sum()
    off = _wrapped(alpha - alpha[0])
    mean = share @ off
    variance = share @ (sigma**2 + (off - mean) ** 2)
    return float(_wrapped(alpha[0] + mean)), math.sqrt(variance)


def _wrapped(angle: FloatArray) -> FloatArray:
    return np.asarray((angle + math.pi) % (2.0 * math.pi) - math.pi)


def close_groups(alpha_rad: ArrayLike, distance_rad: ArrayLike) -> IntArray:
    """Number groups of bearings from the left; neighbours closer than both distances are of one."""
    alpha, distance = np.asarray(alpha_rad), np.asarray(distance_rad)
    order = np.argsort(-alpha, kind="stable")
    apart = -np.diff(alpha[order]) >= np.minimum(distance[order][1:], distance[order][:-1])
    group = np.zeros(len(alpha), np.int64)
    group[order[1:]] = np.cumsum(apart)
    return group
