"""Reference poses of a robot at rest from distances of points on it to surveyed points.

All minima are searched, from starts in all directions, because distances to two points, or to
points on a line, also fit mirrored poses. A pose is accepted only if it is determined, no other
fits nearly as well, and its distances agree within their noise.

Tape measurements in the building are compared with the drawing: distances between two points of it,
and between two fiducials. All files have a row per distance (docs/groundtruth/sessions.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.special import chdtrc

from redetect.array_types import FloatArray
from redetect.bounds import ABOVE_0
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import JsonObject, PathLike, known_name, read_table
from redetect.landmarks import wrap_angle
from redetect.plane import apply, fitted, rotation

DISTANCES_HEAD = "pose,t,point,fiducial,distance_m"
_ENDS = ("point", "fiducial")
_FARTHEST_M = 1e6
# Number of bearings, and of headings, to start from; minima closer than this are equal (m, rad).
_DIRECTIONS, _SAME_M = 12, 1e-4
# Distances are inconsistent if the probability of their misfit is below this.
_GROSS_PROBABILITY = 1e-4
# The best pose is ambiguous if the squared normalised misfit of another is less than this above.
_AMBIGUITY_CHI2 = 20.0
# A pose with larger standard deviations is undetermined.
_LARGEST_SIGMA_M, _LARGEST_SIGMA_DEG = 0.1, 5.0
DIMENSIONS_HEAD = "name,x1_m,y1_m,x2_m,y2_m,measured_m"
FIDUCIAL_DISTANCES_HEAD = "a,b,distance_m"

#: Two fiducials and the measured distance between them (m).
FiducialDistance = tuple[str, str, float]


@dataclass(frozen=True, eq=False)
class Survey:
    """Points between which distances are measured."""

    fiducials: dict[str, FloatArray]  # Surveyed points in the world (m)
    robot_points: dict[str, FloatArray]  # Points on the robot, in its frame (m)
    sigma_m: float  # Standard deviation of a distance (m)


@dataclass(frozen=True)
class Distance:
    """A distance from a point on the robot to a fiducial."""

    pose: int  # Number of the reference pose
    time_s: float  # On the ground truth's clock
    point: str  # The two endpoints
    fiducial: str
    distance_m: float


def read_survey(path: PathLike) -> Survey:
    """Read a ``fiducials.json``; raises `GroundTruthError` if the file or an entry is not valid."""
    content = JsonObject.read(path)
    content.demand_version()
    fiducials, robot_points = (_points(content, key) for key in ("fiducials", "robot_points"))
    return Survey(fiducials, robot_points, content.number("sigma_m", ABOVE_0))


def read_distances(path: PathLike, survey: Survey) -> list[Distance]:
    """Read a ``distances.csv``, which may contain only the survey's points, in the file's order.

    Raises `GroundTruthError` if the file cannot be read, a row is malformed or names an unknown
    point.
    """
    rows = []
    for line, names, (pose, time_s, distance_m) in read_table(path, DISTANCES_HEAD, _ENDS):
        if pose < 0.0 or pose % 1.0 or not 0.0 <= distance_m < _FARTHEST_M:
            raise GroundTruthError(
                f"{path}:{line}: expected a whole pose and a distance of 0 or more"
            )
        point = known_name(path, line, names[0], survey.robot_points)
        fiducial = known_name(path, line, names[1], survey.fiducials)
        rows.append(Distance(int(pose), time_s, point, fiducial, distance_m))
    return rows


def _points(content: JsonObject, key: str) -> dict[str, FloatArray]:
    names = content.values.get(key)
    if not isinstance(names, dict) or len(names) < 2:
        raise GroundTruthError(f"{content.place}: {key}: expected two or more points by name")
    entries = JsonObject(f"{content.place}: {key}", names)
    points = {name: entries.numbers(name, 2) for name in names}
    for name, point in points.items():
        if not np.all(np.abs(point) < _FARTHEST_M):
            raise entries.wrong(name, f"less than {_FARTHEST_M:g} m")
    return points


class DistanceStatus(StrEnum):
    """Whether distances determine a pose, and why not."""

    OK = "ok"
    AMBIGUOUS = "ambiguous"  #: Several poses fit
    UNDETERMINED = "undetermined"  #: A direction is not determined
    INCONSISTENT = "inconsistent"  #: No pose fits


@dataclass(frozen=True, eq=False)
class DistancePose:
    """A reference pose from its distances."""

    index: int  # The pose's number in the file
    time_s: float  # Median of its distances' times
    status: DistanceStatus
    reason: str  # Why it is not ok; empty if it is
    pose: FloatArray  # (3,): best x, y (m), theta (rad); NaN with fewer than three distances
    covariance: FloatArray  # (3, 3): from the distances' standard deviation
    residuals_m: FloatArray  # (K,): measured distances minus those of the pose
    chi2: float  # Squared normalised residuals, with K - 3 degrees of freedom

    @property
    def dof(self) -> int:
        """Degrees of freedom."""
        return len(self.residuals_m) - 3


def poses_from_distances(survey: Survey, distances: Sequence[Distance]) -> list[DistancePose]:
    """Compute every pose for which distances were measured, in order of time."""
    by_pose: dict[int, list[Distance]] = {}
    for distance in distances:
        by_pose.setdefault(distance.pose, []).append(distance)
    found = [_solve(index, rows, survey) for index, rows in by_pose.items()]
    return sorted(found, key=lambda pose: (pose.time_s, pose.index))


def distance_figures(solved: Sequence[DistancePose], sigma_m: float) -> dict[str, float | None]:
    """Residuals of the poses that fit their distances, of standard deviation `sigma_m` (m)."""
    good = [d for d in solved if d.status in (DistanceStatus.OK, DistanceStatus.AMBIGUOUS)]
    residuals = np.concatenate([d.residuals_m for d in good]) if good else np.zeros(0)
    dof = sum(d.dof for d in good)
    return {
        "sigma_m": sigma_m,
        "rms_m": float(np.sqrt(np.mean(residuals**2))) if len(residuals) else 0.0,
        "chi2_per_freedom": float(sum(d.chi2 for d in good) / dof) if dof else None,
    }


class Measured(NamedTuple):
    """The K distances of one pose."""

    fiducials: FloatArray  # (K, 2): endpoints in the world (m)
    levers: FloatArray  # (K, 2): endpoints on the robot, in its frame (m)
    distances_m: FloatArray  # (K,)
    sigma_m: float


def distance_minima(measured: Measured) -> tuple[FloatArray, FloatArray]:
    """All minima of the squared normalised residuals: (M, 3) poses and (M,) chi2, best first.

    By Levenberg-Marquardt with all headings, from all around the fiducial of the first distance.
    """
    # Relative to that fiducial, since the solver's tolerance is relative to the coordinates.
    origin = measured.fiducials[0]
    measured = measured._replace(fiducials=measured.fiducials - origin)
    angles = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    bearing, heading = (part.ravel() for part in np.meshgrid(angles, angles))
    point = measured.fiducials[0] + measured.distances_m[0] * rotation(bearing)[:, :, 0]
    starts = np.column_stack([point - rotation(heading) @ measured.levers[0], heading])

    def residuals(pose: FloatArray) -> FloatArray:
        return distance_residuals(pose, measured)[0]

    def jacobian(pose: FloatArray) -> FloatArray:
        return distance_residuals(pose, measured)[1]

    poses = np.array([least_squares(residuals, at, jacobian, method="lm").x for at in starts])
    poses[:, 2] = wrap_angle(poses[:, 2])
    cost = np.sum(distance_residuals(poses, measured)[0] ** 2, axis=1) / measured.sigma_m**2
    # The best first, without those that are equal to a better one.
    kept: list[int] = []
    for i in np.argsort(cost, kind="stable").tolist():
        apart = np.abs(poses[kept] - poses[i])
        apart[:, 2] = np.abs(wrap_angle(apart[:, 2]))
        if not np.any(apart.max(axis=1, initial=0.0) < _SAME_M):
            kept.append(i)
    return poses[kept] + np.append(origin, 0.0), cost[kept]


def distance_residuals(pose: FloatArray, measured: Measured) -> tuple[FloatArray, FloatArray]:
    """Measured minus expected distances (..., K) (m) of poses (..., 3), and their derivatives by
    the poses (..., K, 3).
    """
    arm = measured.levers @ np.swapaxes(rotation(pose[..., 2]), -1, -2)
    apart = pose[..., None, :2] + arm - measured.fiducials
    length = np.hypot(apart[..., 0], apart[..., 1])
    along = apart / np.maximum(length, 1e-12)[..., None]
    turn = along[..., 1] * arm[..., 0] - along[..., 0] * arm[..., 1]
    return measured.distances_m - length, -np.concatenate([along, turn[..., None]], axis=-1)


def _solve(index: int, rows: Sequence[Distance], survey: Survey) -> DistancePose:
    time_s = float(np.median([row.time_s for row in rows]))
    if len(rows) < 3:
        reason, nothing = f"{len(rows)} distances: expected 3 or more", np.full(len(rows), np.nan)
        pose, open_ = np.full(3, np.nan), np.full((3, 3), np.inf)
        status = DistanceStatus.UNDETERMINED
        return DistancePose(index, time_s, status, reason, pose, open_, nothing, math.nan)
    measured = Measured(
        np.array([survey.fiducials[row.fiducial] for row in rows]),
        np.array([survey.robot_points[row.point] for row in rows]),
        np.array([row.distance_m for row in rows]),
        survey.sigma_m,
    )
    poses, costs = distance_minima(measured)
    residuals, jacobian = distance_residuals(poses[0], measured)
    covariance, dof = _covariance(jacobian, survey.sigma_m), len(rows) - 3
    if dof > 0 and float(chdtrc(dof, costs[0])) < _GROSS_PROBABILITY:
        status = DistanceStatus.INCONSISTENT
        worst = int(np.argmax(np.abs(residuals)))
        reason = (
            "the distances are inconsistent: the largest residual, "
            f"{1e3 * residuals[worst]:+.0f} mm, is that of {rows[worst].point} from "
            f"{rows[worst].fiducial}"
        )
    else:
        status, reason = _determined(poses[costs < costs[0] + _AMBIGUITY_CHI2], covariance)
    pose, chi2 = poses[0], float(costs[0])
    return DistancePose(index, time_s, status, reason, pose, covariance, residuals, chi2)


def _determined(candidates: FloatArray, covariance: FloatArray) -> tuple[DistanceStatus, str]:
    """Status of the first of the poses (C, 3) that fit, with its covariance (3, 3)."""
    sigma = np.sqrt(np.diagonal(covariance))
    place, turn = float(np.hypot(sigma[0], sigma[1])), math.degrees(sigma[2])
    # NaN and infinity fail these comparisons too.
    if not (place < _LARGEST_SIGMA_M and turn < _LARGEST_SIGMA_DEG):
        return DistanceStatus.UNDETERMINED, (
            f"too uncertain by its distances: sigma {place:.3g} m, {turn:.3g} deg: expected at "
            f"most {_LARGEST_SIGMA_M:g} m and {_LARGEST_SIGMA_DEG:g} deg"
        )
    if len(candidates) > 1:
        places = (f"({x:.2f}, {y:.2f}, {math.degrees(t):.0f} deg)" for x, y, t in candidates)
        reason = f"{len(candidates)} poses fit the distances: {', '.join(places)}"
        return DistanceStatus.AMBIGUOUS, reason
    return DistanceStatus.OK, ""


def _covariance(jacobian: FloatArray, sigma_m: float) -> FloatArray:
    """(3, 3); infinite if the distances do not determine a direction."""
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian / sigma_m**2)
    if not values[0] > 1e-10 * values[2]:
        return np.diag(np.full(3, np.inf))
    return np.asarray((vectors / values) @ vectors.T)


class Dimension(NamedTuple):
    """A distance in the drawing that was also measured."""

    name: str
    drawn_m: float
    measured_m: float


class SurveyedFiducials(NamedTuple):
    """Positions of F fiducials from the distances between them."""

    names: tuple[str, ...]
    places: FloatArray  # (F, 2): positions, aligned rigidly with those of the drawing (m)
    drawn: FloatArray  # (F, 2): positions in the drawing (m)
    sigma_m: FloatArray  # (F, 2): standard deviations of `places`, from those of the distances
    residuals_m: FloatArray  # (K,): measured distances minus those between `places`


def read_dimensions(path: PathLike) -> list[Dimension]:
    """Read a ``dimensions.csv``."""
    found = []
    for _, (name,), (x1, y1, x2, y2, measured) in read_table(path, DIMENSIONS_HEAD, ("name",)):
        found.append(Dimension(name, math.hypot(x2 - x1, y2 - y1), measured))
    return found


def read_fiducial_distances(path: PathLike, survey: Survey) -> list[FiducialDistance]:
    """Read a ``fiducial_distances.csv``, which may name only the survey's fiducials."""
    found = []
    for line, names, (distance,) in read_table(path, FIDUCIAL_DISTANCES_HEAD, ("a", "b")):
        a, b = (known_name(path, line, name, survey.fiducials) for name in names)
        found.append((a, b, distance))
    return found


def survey_fiducials(survey: Survey, distances: list[FiducialDistance]) -> SurveyedFiducials:
    """Estimate the positions of fiducials from the distances between them, by least squares.

    Distances do not determine a rigid motion: the positions are aligned with the drawing, and the
    standard deviations are those of a free network (of least trace). Raises `GroundTruthError` if
    the distances leave more than that undetermined.
    """
    names = tuple(survey.fiducials)
    drawn = np.stack([survey.fiducials[name] for name in names])
    fewest = 2 * len(names) - 3
    undetermined = GroundTruthError(
        f"{len(distances)} distances do not determine the positions of {len(names)} fiducials"
    )
    if len(distances) < fewest:
        raise undetermined
    ends = np.array([(names.index(a), names.index(b)) for a, b, _ in distances])
    measured = np.array([distance_m for _, _, distance_m in distances])

    def residuals(flat: FloatArray) -> FloatArray:
        apart = flat.reshape(-1, 2)[ends[:, 0]] - flat.reshape(-1, 2)[ends[:, 1]]
        return np.asarray(np.hypot(apart[:, 0], apart[:, 1]) - measured)

    found = least_squares(residuals, drawn.ravel(), xtol=1e-12, ftol=1e-12)
    if np.linalg.matrix_rank(found.jac, tol=1e-6) < fewest:
        raise undetermined
    places = found.x.reshape(-1, 2)
    motion = fitted(places, drawn)
    variances = survey.sigma_m**2 * np.linalg.pinv(found.jac.T @ found.jac, rcond=1e-9)
    each = np.arange(len(names))
    blocks = variances.reshape(len(names), 2, len(names), 2)[each, :, each]
    turned = rotation(motion[2]) @ blocks @ rotation(motion[2]).T
    sigma = np.sqrt(np.diagonal(turned, axis1=1, axis2=2))
    return SurveyedFiducials(names, apply(motion, places), drawn, sigma, -found.fun)
