"""Reference poses of a robot at rest from distances of points on it to surveyed points.

All minima are searched, from starts all round: distances to two points, or to points on a line, fit
mirrored poses as well. A pose is accepted only if it is determined, no other fits nearly as well,
and its distances agree within their noise, except for gross errors that can be identified.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.validation.fiducials import Distance, Survey
from redetect.landmarks import wrap_angle
from redetect.storage.bounds import ABOVE_0, PROBABILITY, demand, whole

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Status = Literal["ok", "ambiguous", "undetermined", "inconsistent"]

_HEADINGS = 24
_STEPS = 80
_MERGED_AT, _MERGED_M = 12, 1e-3
_SAME_M = 1e-4


@dataclass(frozen=True)
class DistanceSettings:
    """When distances give a pose.

    Parameters
    ----------
    gross_probability : float
        Distances that fit less well than this share of right ones hold a gross error.
    most_gross : int
        At most this many of a pose's distances are left out as gross errors.
    ambiguity_chi2 : float
        Another pose within this squared normalised misfit of the best makes it ambiguous.
    largest_sigma_m, largest_sigma_deg : float
        A pose known less well than this is undetermined.

    Raises
    ------
    GroundTruthError
        If a number is out of range.
    """

    gross_probability: float = 1e-4
    most_gross: int = 2
    ambiguity_chi2: float = 20.0
    largest_sigma_m: float = 0.1
    largest_sigma_deg: float = 5.0

    def __post_init__(self) -> None:
        demand(
            self,
            GroundTruthError,
            gross_probability=PROBABILITY,
            most_gross=whole(0, 10),
            ambiguity_chi2=ABOVE_0,
            largest_sigma_m=ABOVE_0,
            largest_sigma_deg=ABOVE_0,
        )


@dataclass(frozen=True, eq=False)
class DistancePose:
    """A reference pose from its distances.

    Attributes
    ----------
    index : int
        The pose's number in the file.
    time_s : float
        Median of its distances' times.
    status : str
        `ok`; `ambiguous`: several poses fit; `undetermined`: a direction is open; `inconsistent`:
        no pose fits.
    reason : str
        What is wrong, if anything.
    candidates : (C, 3) float64
        Poses x, y (m), theta (rad) that fit, the best first; one if the status is `ok`.
    covariances : (C, 3, 3) float64
        From the distances' standard deviation.
    residuals_m : (K,) float64
        Measured distances minus those of the best candidate.
    used : (K,) bool
        False for gross errors.
    chi2 : float
        Squared normalised residuals of those used, with `freedom` degrees of freedom.
    freedom : int
    """

    index: int
    time_s: float
    status: Status
    reason: str
    candidates: FloatArray
    covariances: FloatArray
    residuals_m: FloatArray
    used: BoolArray
    chi2: float
    freedom: int


def poses_from_distances(
    survey: Survey, distances: Sequence[Distance], settings: DistanceSettings | None = None
) -> list[DistancePose]:
    """Work out every pose for which distances were measured.

    Parameters
    ----------
    survey : Survey
    distances : sequence of Distance
    settings : DistanceSettings, optional

    Returns
    -------
    list of DistancePose
        In order of the poses' times.
    """
    s = DistanceSettings() if settings is None else settings
    by_pose: dict[int, list[Distance]] = {}
    for distance in distances:
        by_pose.setdefault(distance.pose, []).append(distance)
    found = []
    for index, rows in sorted(by_pose.items()):
        fiducials = np.array([survey.fiducials[row.fiducial] for row in rows])
        levers = np.array([survey.robot_points[row.point] for row in rows])
        lengths = np.array([row.distance_m for row in rows])
        time = float(np.median([row.time_s for row in rows]))
        found.append(_solve(index, time, fiducials, levers, lengths, survey.sigma_m, s))
    return sorted(found, key=lambda pose: (pose.time_s, pose.index))


def distance_minima(
    fiducials: FloatArray, levers: FloatArray, distances_m: FloatArray, sigma_m: float
) -> tuple[FloatArray, FloatArray]:
    """All local minima of the squared normalised residuals.

    Starts are where, for headings all round, two circles about fiducial points meet; each is
    refined by Levenberg-Marquardt steps.

    Parameters
    ----------
    fiducials : (K, 2) array
        Points in the world (m).
    levers : (K, 2) array
        Points on the robot, in its frame (m).
    distances_m : (K,) array
    sigma_m : float

    Returns
    -------
    poses : (M, 3) float64
        x, y (m), theta (rad), the best first.
    chi2 : (M,) float64
    """
    poses = _starts(fiducials, levers, distances_m)
    residuals, jacobian = _linearised(poses, fiducials, levers, distances_m, sigma_m)
    cost = np.sum(residuals**2, axis=1)
    damping = np.full(len(poses), 1e-3)
    for count in range(_STEPS):
        if count == _MERGED_AT:  # most starts have met in few minima by now
            poses[:, 2] = wrap_angle(poses[:, 2])
            apart = _distinct(poses, cost, _MERGED_M)
            poses, cost, damping = poses[apart], cost[apart], damping[apart]
            residuals, jacobian = residuals[apart], jacobian[apart]
        normal = np.einsum("ski,skj->sij", jacobian, jacobian)
        diagonal = np.einsum("sii->si", normal)
        slope = np.einsum("ski,sk->si", jacobian, residuals)
        damped = normal + np.eye(3) * (damping[:, None] * diagonal + 1e-12)[:, None, :]
        step = -np.linalg.solve(damped, slope[..., None])[..., 0]
        tried = poses + step
        new_residuals, new_jacobian = _linearised(tried, fiducials, levers, distances_m, sigma_m)
        new_cost = np.sum(new_residuals**2, axis=1)
        better = new_cost <= cost
        poses = np.where(better[:, None], tried, poses)
        residuals = np.where(better[:, None], new_residuals, residuals)
        jacobian = np.where(better[:, None, None], new_jacobian, jacobian)
        cost = np.where(better, new_cost, cost)
        damping = np.clip(np.where(better, 0.2 * damping, 5.0 * damping), 1e-12, 1e12)
        if np.all(np.abs(step[better]) < 1e-10) and np.all(damping[~better] > 1e9):
            break
    poses[:, 2] = wrap_angle(poses[:, 2])
    kept = _distinct(poses, cost, _SAME_M)
    return poses[kept], cost[kept]


def distance_residuals(
    pose: FloatArray, fiducials: FloatArray, levers: FloatArray, distances_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Measured minus expected distances (K,) in metres, and their (K, 3) derivative by the pose."""
    residuals, jacobian = _linearised(pose[None], fiducials, levers, distances_m, 1.0)
    return -residuals[0], -jacobian[0]


def _solve(
    index: int,
    time_s: float,
    fiducials: FloatArray,
    levers: FloatArray,
    lengths: FloatArray,
    sigma_m: float,
    s: DistanceSettings,
) -> DistancePose:
    count = len(lengths)
    used = np.ones(count, dtype=np.bool_)
    nothing = np.zeros((0, 3))
    if count < 3:
        return DistancePose(
            index, time_s, "undetermined", f"{count} distances: expected 3 or more", nothing,
            np.zeros((0, 3, 3)), np.full(count, np.nan), used, math.nan, count - 3,
        )  # fmt: skip
    status: Status = "ok"
    poses, costs = distance_minima(fiducials, levers, lengths, sigma_m)
    reason = ""
    if _improbable(costs[0], count - 3, s):
        kept, reason = _without_gross(fiducials, levers, lengths, sigma_m, s)
        if kept is None:
            status = "inconsistent"
        else:
            used = kept
            poses, costs = distance_minima(fiducials[used], levers[used], lengths[used], sigma_m)
    rivals = costs < costs[0] + s.ambiguity_chi2
    candidates = poses[rivals]
    residuals, _ = distance_residuals(candidates[0], fiducials, levers, lengths)
    covariances = np.stack(
        [
            _covariance(distance_residuals(pose, fiducials, levers, lengths)[1][used], sigma_m)
            for pose in candidates
        ]
    )
    if status == "ok":
        status, fault = _determined(candidates, covariances, s)
        reason = "; ".join(part for part in (fault, reason) if part)
    return DistancePose(
        index, time_s, status, reason, candidates, covariances, residuals, used,
        float(costs[0]), int(used.sum()) - 3,
    )  # fmt: skip


def _determined(
    candidates: FloatArray, covariances: FloatArray, s: DistanceSettings
) -> tuple[Status, str]:
    sigma = np.sqrt(np.diagonal(covariances[0]))
    place, turn = float(np.hypot(sigma[0], sigma[1])), math.degrees(sigma[2])
    # NaN and infinity fail these comparisons too.
    if not (place < s.largest_sigma_m and turn < s.largest_sigma_deg):
        return "undetermined", (
            f"the distances leave it open: sigma {place:.3g} m, {turn:.3g} deg: expected at most "
            f"{s.largest_sigma_m:g} m and {s.largest_sigma_deg:g} deg"
        )
    if len(candidates) > 1:
        others = ", ".join(
            f"({x:.2f}, {y:.2f}, {math.degrees(t):.0f} deg)" for x, y, t in candidates
        )
        return "ambiguous", f"{len(candidates)} poses fit the distances: {others}"
    return "ok", ""


def _without_gross(
    fiducials: FloatArray,
    levers: FloatArray,
    lengths: FloatArray,
    sigma_m: float,
    s: DistanceSettings,
) -> tuple[BoolArray | None, str]:
    """Which distances to keep so that the rest agrees, or None, and what there is to say."""
    used = np.ones(len(lengths), dtype=np.bool_)
    for removed in range(1, s.most_gross + 1):
        # With less than one degree of freedom left anything fits.
        if int(used.sum()) - 1 < 4:
            break
        trials = []
        for k in np.flatnonzero(used).tolist():
            kept = used.copy()
            kept[k] = False
            poses, costs = distance_minima(fiducials[kept], levers[kept], lengths[kept], sigma_m)
            trials.append((float(costs[0]), k, poses[0]))
        trials.sort(key=lambda trial: trial[0])
        used[trials[0][1]] = False
        freedom = int(used.sum()) - 3
        if not _improbable(trials[0][0], freedom, s):
            if len(trials) > 1 and not _improbable(trials[1][0], freedom, s):
                return None, "the distances contradict each other, and it is not clear which errs"
            plural = "s" if removed > 1 else ""
            return used, f"{removed} gross error{plural} left out"
    return None, "the distances contradict each other"


def _improbable(cost: float, freedom: int, s: DistanceSettings) -> bool:
    return freedom > 0 and float(chdtrc(freedom, cost)) < s.gross_probability


def _covariance(jacobian: FloatArray, sigma_m: float) -> FloatArray:
    """(3, 3); infinite where the distances leave a direction open."""
    information = jacobian.T @ jacobian / sigma_m**2
    values, vectors = np.linalg.eigh(information)
    if not values[0] > 1e-10 * values[2]:
        return np.diag(np.full(3, np.inf))
    return np.asarray((vectors / values) @ vectors.T)


def _linearised(
    poses: FloatArray,
    fiducials: FloatArray,
    levers: FloatArray,
    distances_m: FloatArray,
    sigma_m: float,
) -> tuple[FloatArray, FloatArray]:
    """Normalised residuals (S, K), expected minus measured, and derivatives (S, K, 3)."""
    c, sine = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    lever_x = c * levers[:, 0] - sine * levers[:, 1]
    lever_y = sine * levers[:, 0] + c * levers[:, 1]
    x = poses[:, 0, None] + lever_x - fiducials[:, 0]
    y = poses[:, 1, None] + lever_y - fiducials[:, 1]
    length = np.hypot(x, y)
    safe = np.maximum(length, 1e-12)
    x, y = x / safe, y / safe
    jacobian = np.stack([x, y, y * lever_x - x * lever_y], axis=-1)
    return (length - distances_m) / sigma_m, jacobian / sigma_m


def _starts(fiducials: FloatArray, levers: FloatArray, distances_m: FloatArray) -> FloatArray:
    """(S, 3) poses at which, for a heading, two of the distances are right."""
    pairs = _wide_pairs(fiducials)
    starts = []
    for heading in np.arange(_HEADINGS) * (2.0 * np.pi / _HEADINGS):
        c, s = np.cos(heading), np.sin(heading)
        centres = fiducials - levers @ np.array([[c, s], [-s, c]])
        for k, m in pairs:
            across = centres[m] - centres[k]
            apart = max(float(np.hypot(*across)), 1e-9)
            unit = across / apart
            along = (apart**2 + distances_m[k] ** 2 - distances_m[m] ** 2) / (2.0 * apart)
            # Noise, or the wrong heading, keeps circles apart: then the place nearest to both.
            along = float(np.clip(along, -distances_m[k], distances_m[k]))
            up = math.sqrt(max(distances_m[k] ** 2 - along**2, 0.0))
            for side in (up, -up):
                place = centres[k] + along * unit + side * np.array([-unit[1], unit[0]])
                starts.append((place[0], place[1], heading))
    return np.array(starts)


def _distinct(poses: FloatArray, cost: FloatArray, closer: float) -> list[int]:
    """Indices of poses, the best first, without those closer (m, rad) to a better one."""
    kept: list[int] = []
    for i in np.argsort(cost, kind="stable").tolist():
        apart = np.abs(poses[kept] - poses[i])
        apart[:, 2] = np.abs(wrap_angle(apart[:, 2]))
        if not np.any(apart.max(axis=1, initial=0.0) < closer):
            kept.append(i)
    return kept


def _wide_pairs(fiducials: FloatArray) -> list[tuple[int, int]]:
    """Two pairs of far fiducials that share no distance, so that one gross error spoils one."""
    apart = np.hypot(*(fiducials[:, None] - fiducials[None]).transpose(2, 0, 1))
    pairs = []
    for _ in range(2):
        k, m = (int(i) for i in np.unravel_index(int(np.argmax(apart)), apart.shape))
        if k != m:
            pairs.append((k, m))
            apart[[k, m], :] = -1.0
            apart[:, [k, m]] = -1.0
    return pairs or [(0, 1)]
