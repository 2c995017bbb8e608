"""Errors of streams of poses: their jitter from sample to sample, and what all poses share.

Jitter: differences of a high order cancel the motion; those with gross errors do not count. It is a
lower bound of a stream's errors, since those that change slowly are not seen. Errors that all poses
share, such as those of the scanners' poses, do not average out. So streams are fused without them,
and they are added to the fused path, which has the same error.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import JsonObject, PathLike
from redetect.groundtruth.trajectories.streams import (
    RAWSEEDS_ROUNDING,
    PlanarPoses,
    last_of_each_time,
)

# Median of the absolute value of a standard normal number.
_MEDIAN_OF_NORMAL = 0.6745
# Order of the differences that are compared with covariances: fifth ones cancel the motion even at
# four poses a second, the fewest.
_ORDER = 5
# Of those from which the noise itself is estimated.
_NOISE_ORDER = 3
_LEAST_RATE_HZ = 4.0
_FEWEST = 50
# Differences over times longer than usual by this factor do not count.
_LONGEST = 1.5
# A gross error is farther from the median of this number of poses than this many deviations.
_NEIGHBOURS, _GROSS = 7, 6.0
# Least gross error that is removed (m, rad): a turning point of a robot is none.
_LEAST_GROSS = 0.12
# Covariances are raised if the jitter exceeds their deviations by more than this factor.
_BELIEVED = 1.5
# Ratio of eigenvalues below which a covariance is singular.
_SINGULAR = 1e-9
#: Its name in the file beside a stream.
COMMON = "common_covariance"
# A common covariance below this share of the poses' own is left in them.
_NEGLIGIBLE = 0.05
# Least share of a pose's variance that is left without the common part, which is a mean.
_LEAST_OWN = 0.02


def white_noise_sigmas(poses: PlanarPoses) -> FloatArray:
    """(3,) standard deviations of the noise of x, y and the heading, from third differences."""
    if len(poses) <= _NOISE_ORDER:
        return np.zeros(3)
    weights = _divided_differences(poses.times_s, _NOISE_ORDER)
    third = np.sum(weights * _neighbours(poses.continuous, _NOISE_ORDER), axis=0)
    return np.asarray(np.median(np.abs(third), axis=0) / _MEDIAN_OF_NORMAL)


def rounding_sigmas(poses: PlanarPoses) -> FloatArray:
    """(3,) standard deviations of x, y and the heading that are due to their rounding."""
    found = np.zeros(3)
    for k, levels in enumerate(np.unique(np.round(values, 9)) for values in poses.poses.T):
        step = min(np.diff(levels), default=0.0)
        if step > 0.0 and np.all(np.abs(levels - step * np.rint(levels / step)) < 0.01 * step):
            found[k] = step / math.sqrt(12.0)
    return found


def _divided_differences(times_s: FloatArray, order: int) -> FloatArray:
    """(order + 1, N - order, 1) weights of neighbours in divided differences; squares add to 1.

    Divided by time, differences cancel the motion at uneven times, too, such as those of cameras
    that are not triggered together.
    """
    times = _neighbours(times_s, order)
    apart = [np.prod(times[k] - np.delete(times, k, axis=0), axis=0) for k in range(order + 1)]
    weights = 1.0 / np.stack(apart)[..., None]
    return np.asarray(weights / np.linalg.norm(weights, axis=0))


def _neighbours(values: FloatArray, order: int) -> FloatArray:
    """(order + 1, N - order, ...) all rows of `order` + 1 neighbours among values (N, ...)."""
    count = len(values) - order
    return np.stack([values[k : k + count] for k in range(order + 1)])


def jitter_ratio(poses: PlanarPoses) -> float:
    """Jitter of poses in their standard deviations: about 1 if these are right.

    The largest of x, y and the heading; 0 without covariances, or with too few or too slow poses.
    """
    poses = last_of_each_time(poses)
    if poses.covariances is None or len(poses) - _ORDER < _FEWEST:
        return 0.0
    over = poses.times_s[_ORDER:] - poses.times_s[:-_ORDER]
    usual = float(np.median(over))
    counted = over <= _LONGEST * usual
    if usual > _ORDER / _LEAST_RATE_HZ or np.count_nonzero(counted) < _FEWEST:
        return 0.0
    variances = np.diagonal(poses.covariances, axis1=1, axis2=2)
    gross = _gross_errors(poses.continuous, np.sqrt(variances))
    counted &= np.convolve(gross, np.ones(_ORDER + 1), "valid") == 0.0
    if np.count_nonzero(counted) < _FEWEST:
        return 0.0
    normalised = np.abs(_normalised_differences(poses, variances)[counted])
    return float(np.max(np.median(normalised, axis=0)) / _MEDIAN_OF_NORMAL)


def _normalised_differences(poses: PlanarPoses, variances: FloatArray) -> FloatArray:
    """(N - 5, 3) divided differences of poses in their deviations, from (N, 3) variances."""
    weights = _divided_differences(poses.times_s, _ORDER)
    apart = np.sum(weights * _neighbours(poses.continuous, _ORDER), axis=0)
    return np.asarray(apart / np.sqrt(np.sum(weights**2 * _neighbours(variances, _ORDER), axis=0)))


def _gross_errors(values: FloatArray, sigmas: FloatArray) -> BoolArray:
    """(N,) mask of rows of numbers (N, 3) far from those beside them, in their own deviations and
    in those stated, (N, 3) or (3,).
    """
    apart = np.abs(values - median_filter(values, (_NEIGHBOURS, 1), mode="nearest"))
    usual = np.median(apart, axis=0) / _MEDIAN_OF_NORMAL
    return np.asarray(np.any(apart > _GROSS * np.maximum(usual, sigmas), axis=1))


def without_gross_errors(poses: PlanarPoses) -> PlanarPoses:
    """Poses without those that are far from the ones beside them; all of few or slow ones."""
    if len(poses) < _FEWEST or np.median(np.diff(poses.times_s)) > 1.0 / _LEAST_RATE_HZ:
        return poses
    return poses.only(~_gross_errors(poses.continuous, np.full(3, _LEAST_GROSS / _GROSS)))


def with_usable_covariances(name: str, poses: PlanarPoses) -> tuple[PlanarPoses, int]:
    """Poses with symmetric covariances, increased where rounding made them singular, and of how
    many; of several poses at one time, the last.

    Raises `GroundTruthError` if they have none, or some that rounding does not explain; `name` is
    that of the stream.
    """
    poses = last_of_each_time(poses)
    if poses.covariances is None:
        raise GroundTruthError(f"{name}: no covariances: expected t, x, y, theta and 9 more")
    symmetric = 0.5 * (poses.covariances + np.swapaxes(poses.covariances, 1, 2))
    smallest, _, largest = np.linalg.eigvalsh(symmetric).T
    worst = float(smallest.min(initial=0.0))
    # Three entries of a row may each be off by the rounding.
    if worst < -3.0 * RAWSEEDS_ROUNDING:
        raise GroundTruthError(
            f"{name}: pose {int(np.argmin(smallest)) + 1} has a covariance with eigenvalue "
            f"{worst:.3g}: expected none below what rounding to six decimals makes of 0"
        )
    # Precise poses, with more decimals, are not singular.
    units = symmetric / (2.0 * RAWSEEDS_ROUNDING)
    rounded = np.all(np.abs(units - np.rint(units)) < 1e-3, axis=(1, 2))
    weak = smallest <= np.where(rounded, RAWSEEDS_ROUNDING * 0.1, _SINGULAR * largest)
    added = RAWSEEDS_ROUNDING + np.maximum(0.0, -smallest[weak])
    symmetric[weak] += np.eye(3) * added[:, None, None]
    return PlanarPoses(poses.times_s, poses.poses, symmetric), int(np.count_nonzero(weak))


def with_jitter_covered(poses: PlanarPoses) -> tuple[PlanarPoses, float]:
    """Poses with covariances raised to their jitter, and this in stated deviations, 1 if these can
    be right. Covariances are not lowered, since errors that change slowly do not jitter.
    """
    factor = jitter_ratio(poses)
    if factor <= _BELIEVED:
        return poses, factor if 0.0 < factor < 1.0 / _BELIEVED else 1.0
    assert poses.covariances is not None
    return PlanarPoses(poses.times_s, poses.poses, factor**2 * poses.covariances), factor


def file_beside(stream: PathLike) -> Path:
    """The .json beside a stream, which may be packed (``.gz``)."""
    path = Path(stream)
    return (path.with_suffix("") if path.suffix == ".gz" else path).with_suffix(".json")


def read_common_covariance(stream: PathLike) -> FloatArray:
    """(3, 3) covariance that is common to a stream's poses, from the .json that
    `groundtruth laser` wrote beside it; zeros if there is none.
    """
    path = file_beside(stream)
    if path.is_file() and COMMON in (content := JsonObject.read(path)):
        return content.covariance(COMMON, 3)
    return np.zeros((3, 3))


def without_common(poses: PlanarPoses, common: FloatArray) -> tuple[PlanarPoses, FloatArray]:
    """Poses without the common part (3, 3) of their covariances, and that part: the same poses, and
    zeros, if it is negligible.
    """
    if poses.covariances is None or not len(poses):
        return poses, np.zeros((3, 3))
    variances = np.diagonal(poses.covariances, axis1=1, axis2=2)
    if np.all(np.diag(common) <= _NEGLIGIBLE * np.median(variances, axis=0)):
        return poses, np.zeros((3, 3))
    # In units of each pose's deviations, no direction may lose all of its variance.
    scale = np.sqrt(variances)
    units = scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh((poses.covariances - common) / units)
    own = (vectors * np.maximum(values, _LEAST_OWN)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return PlanarPoses(poses.times_s, poses.poses, own * units), common


def with_common(poses: PlanarPoses, common: FloatArray) -> PlanarPoses:
    """Poses with a common part (3, 3) added to their covariances."""
    assert poses.covariances is not None
    return PlanarPoses(poses.times_s, poses.poses, poses.covariances + common)
