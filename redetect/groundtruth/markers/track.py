"""A robot's poses over a session, with ambiguities decided by neighbouring times, and a report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from redetect.array_types import FloatArray, IntArray
from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.markers.poses import PoseEstimate, estimate_pose
from redetect.groundtruth.markers.refinement import RefinedPose, pose_problem
from redetect.groundtruth.markers.session import MarkerFrame, Network, Rig, View, rig_views
from redetect.groundtruth.settings import PoseSettings
from redetect.groundtruth.trajectories import se3
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.landmarks import squared_mahalanobis

# Costs as negative log-likelihoods: skipping a frame is cheaper than two jumps around it, and a
# robot that was carried elsewhere costs one jump.
_JUMP_COST = 20.0
_REJECT_COST = 15.0
# Most consecutive frames that are skipped, and rounding errors of costs.
_MOST_LEFT_OUT = 3
_ROUNDING = 1e-6
_CHANCE = 1e-3  # Probability of larger residuals below which they are not due to chance

_Step = tuple[int, int, float]


class PoseStatus(StrEnum):
    """Whether a time has a pose, and why not."""

    CLEAR = "clear"  #: There is only one candidate
    RESOLVED = "resolved"  #: One of several candidates, by the times before and after
    UNRESOLVED = "unresolved"  #: No candidate is likely enough
    REJECTED = "rejected"  #: No candidate fits the times before and after
    FAILED = "failed"  #: No pose explains the corners
    UNSEEN = "unseen"  #: No marker of the rig is in any image


@dataclass(frozen=True, eq=False)
class TrackedTime:
    """Result for one time."""

    time_s: float  # Mean of the images' times that show a marker of the rig
    images: tuple[MarkerFrame, ...]
    views: tuple[View, ...]  # The rig's markers in them
    status: PoseStatus
    estimate: PoseEstimate | None = None
    choice: Choice | None = None
    reason: str = ""  # Why there is no pose, or a remark on it
    pose: RefinedPose | None = None  # The robot's; None if there is no reliable one


@dataclass(frozen=True, eq=False)
class Track:
    """A robot's poses over time."""

    times: tuple[TrackedTime, ...]
    unknown_markers: int  # Markers found in the images that are not on the rig

    @property
    def posed(self) -> list[tuple[float, RefinedPose]]:
        """Times with a pose."""
        return [(t.time_s, t.pose) for t in self.times if t.pose is not None]

    @property
    def counts(self) -> dict[PoseStatus, int]:
        """Number of times by status."""
        return {status: sum(t.status == status for t in self.times) for status in PoseStatus}

    @property
    def chi2_per_dof(self) -> float:
        """Sum of all costs over their degrees of freedom: 1 if the covariances are right."""
        dof = sum(pose.degrees_of_freedom for _, pose in self.posed)
        return sum(pose.cost for _, pose in self.posed) / dof if dof else float("nan")

    def planar(self) -> PlanarPoses:
        """The poses on the floor with their covariances, raised where residuals contradict them."""
        posed = self.posed
        poses = np.array([pose.world_from_robot for _, pose in posed]).reshape(-1, 4, 4)
        raised = [excess_of(pose) * pose.covariance for _, pose in posed]
        return PlanarPoses(
            np.array([time_s for time_s, _ in posed], dtype=np.float64),
            np.column_stack([poses[:, 0, 3], poses[:, 1, 3], se3.heading(poses)]),
            se3.planar_covariance(poses, np.array(raised).reshape(-1, 6, 6)),
        )


def excess_of(pose: RefinedPose) -> float:
    """Factor by which a pose's covariance is too small; 1 if its residuals may be so by chance."""
    dof = pose.degrees_of_freedom
    if dof < 1 or pose.cost <= chdtri(dof, _CHANCE):
        return 1.0
    return pose.cost / dof


def track_by_markers(
    groups: Iterable[tuple[MarkerFrame, ...]], rig: Rig, network: Network, settings: PoseSettings
) -> Track:
    """Compute the robot's poses from the markers found in a session's images.

    `groups` are the images of each time (`redetect.groundtruth.markers.session.group_by_time`),
    their cameras' indices those of `network`.
    """
    tracked: list[TrackedTime] = []
    unknown = 0
    for group in groups:
        views = tuple(rig_views(group, rig))
        unknown += sum(len(frame.markers) for frame in group) - len(views)
        tracked.append(_estimated(group, views, rig, network, settings))
    open_times = [i for i, t in enumerate(tracked) if t.estimate is not None]
    choices = choose_candidates(
        [tracked[i].time_s for i in open_times],
        [estimate for t in tracked if (estimate := t.estimate) is not None],
        settings,
    )
    for i, choice in zip(open_times, choices):
        tracked[i] = _decided(tracked[i], choice)
    return Track(tuple(tracked), unknown)


def report_entry(tracked: TrackedTime, network: Network) -> dict[str, Any]:
    """Record of one time for a line of JSON: markers seen and used, and decisions."""
    entry: dict[str, Any] = {
        "time_s": round(tracked.time_s, 6),
        "status": tracked.status,
        "images": {network.names[frame.camera]: frame.prefix for frame in tracked.images},
    }
    if tracked.reason:
        entry["reason"] = tracked.reason
    markers: list[dict[str, Any]] = [
        {"camera": network.names[view.frame.camera], "id": view.marker.id} for view in tracked.views
    ]
    estimate, choice = tracked.estimate, tracked.choice
    if estimate is not None:
        chosen = estimate.candidates[(choice.candidate or 0) if choice is not None else 0]
        figures = iter(zip(chosen.view_errors, chosen.view_rms_px))
        for marker, is_used in zip(markers, estimate.views):
            marker["used"] = bool(is_used)
            if is_used:
                error, rms = next(figures)
                marker["error"], marker["rms_px"] = round(float(error), 3), round(float(rms), 4)
        entry["ambiguous"] = estimate.ambiguous
        if choice is not None and estimate.ambiguous:
            entry["margin"] = round(choice.margin, 3)
        entry["candidates"] = [
            {
                "x_y_theta": [
                    *(round(float(v), 6) for v in candidate.world_from_robot[:2, 3]),
                    round(float(se3.heading(candidate.world_from_robot)), 6),
                ],
                "z_m": round(float(candidate.world_from_robot[2, 3]), 6),
                "rms_px": round(candidate.rms_px, 4),
                "cost": round(candidate.cost, 3),
                "degrees_of_freedom": candidate.degrees_of_freedom,
                "log_odds_against": round(odds, 3),
            }
            for candidate, odds in zip(estimate.candidates, estimate.log_odds)
        ]
    return {**entry, "markers": markers}


def _estimated(
    group: tuple[MarkerFrame, ...],
    views: tuple[View, ...],
    rig: Rig,
    network: Network,
    settings: PoseSettings,
) -> TrackedTime:
    shown = {view.frame for view in views}
    time_s = float(np.mean([f.time_s for f in group if f in shown or not shown]))
    if not views:
        return TrackedTime(time_s, group, views, PoseStatus.UNSEEN)
    try:
        estimate = estimate_pose(pose_problem(views, rig, network, settings))
    except GeometryError as error:
        return TrackedTime(time_s, group, views, PoseStatus.FAILED, reason=str(error))
    return TrackedTime(time_s, group, views, PoseStatus.UNRESOLVED, estimate)


def _decided(tracked: TrackedTime, choice: Choice) -> TrackedTime:
    reasons = {
        PoseStatus.REJECTED: "does not fit the times before and after",
        PoseStatus.RESOLVED: "planar ambiguity, decided by the neighbours",
        PoseStatus.UNRESOLVED: "planar ambiguity, not decided by the neighbours",
    }
    pose = None
    if choice.status in (PoseStatus.CLEAR, PoseStatus.RESOLVED):
        assert tracked.estimate is not None
        assert choice.candidate is not None
        pose = tracked.estimate.candidates[choice.candidate]
    reason = reasons.get(choice.status, "")
    return replace(tracked, status=choice.status, choice=choice, reason=reason, pose=pose)


@dataclass(frozen=True)
class Choice:
    """The candidate of a frame that is the robot's pose."""

    candidate: int | None  # None if no candidate of the frame fits its neighbours
    status: PoseStatus  # If it is unresolved, the candidate is the most likely one
    margin: float  # Natural logarithm of the odds against the next candidate; infinite without one.


def choose_candidates(
    times_s: Sequence[float], estimates: Sequence[PoseEstimate], settings: PoseSettings
) -> list[Choice]:
    """Decide between the candidates of each frame by its neighbours; times ascend."""
    if not estimates:
        return []
    frame = np.repeat(np.arange(len(estimates)), [len(e.candidates) for e in estimates])
    through = _cheapest_paths(_steps(times_s, estimates, frame, settings), frame)
    cheapest = min(float(through.min()), _REJECT_COST * len(estimates))
    choices = []
    for number, estimate in enumerate(estimates):
        costs = through[frame == number]
        # The cheapest sequence skips the frame.
        if cheapest < costs.min() - _ROUNDING:
            choices.append(Choice(None, PoseStatus.REJECTED, float(costs.min() - cheapest)))
            continue
        total = costs + np.array(estimate.log_odds)
        order = np.argsort(total, kind="stable")
        if len(order) == 1:
            choices.append(Choice(0, PoseStatus.CLEAR, float("inf")))
            continue
        margin = float(total[order[1]] - total[order[0]])
        decided = margin >= np.log(settings.ambiguity_odds)
        status = PoseStatus.RESOLVED if decided else PoseStatus.UNRESOLVED
        choices.append(Choice(int(order[0]), status, margin))
    return choices


def _steps(
    times_s: Sequence[float],
    estimates: Sequence[PoseEstimate],
    frame: IntArray,
    settings: PoseSettings,
) -> list[_Step]:
    """Steps between candidates of neighbouring frames, each with its cost, by their end.

    The cost is half the squared Mahalanobis length of the movement, limited to a jump, and that of
    the frames skipped. `frame` (K,): frame of each candidate, counted over all frames.
    """
    nearest = np.searchsorted(frame, frame)
    farthest = np.searchsorted(frame, frame - 1 - _MOST_LEFT_OUT)
    second = np.repeat(np.arange(len(frame)), nearest - farthest)
    first = np.concatenate([np.arange(*part) for part in zip(farthest, nearest)])
    poses = np.stack([c.world_from_robot for e in estimates for c in e.candidates])
    covariances = np.stack([c.covariance for e in estimates for c in e.candidates])
    # Movements in the world's axes.
    a, b = poses[first], poses[second]
    rotation_a, rotation_b = a[:, :3, :3], b[:, :3, :3]
    turned = Rotation.from_matrix(rotation_b @ rotation_a.transpose(0, 2, 1)).as_rotvec()
    moved = np.concatenate([b[:, :3, 3] - a[:, :3, 3], turned], axis=1)
    spread = np.zeros((len(moved), 6, 6))
    for pose_rotation, which in ((rotation_a, first), (rotation_b, second)):
        axes = np.zeros((len(moved), 6, 6))
        axes[:, :3, :3] = pose_rotation
        axes[:, 3:, 3:] = rotation_b
        spread += axes @ covariances[which] @ axes.transpose(0, 2, 1)
    at = np.asarray(times_s)[frame]
    seconds = at[second] - at[first]
    reach, turn = settings.speed_m_s * seconds, np.radians(settings.turn_deg_s) * seconds
    heave, wobble = settings.heave_m, np.radians(settings.wobble_deg)
    for axis, sigma in enumerate((reach, reach, heave, wobble, wobble, turn)):
        spread[:, axis, axis] += np.square(sigma)
    costs = np.minimum(0.5 * squared_mahalanobis(moved, spread), _JUMP_COST)
    costs += _REJECT_COST * (frame[second] - frame[first] - 1)
    return list(zip(first.tolist(), second.tolist(), costs.tolist()))


def _cheapest_paths(steps: Sequence[_Step], frame: IntArray) -> FloatArray:
    """(K,) cost of the cheapest sequence through each candidate; `frame` (K,) is that of each."""
    ahead, back = _REJECT_COST * frame, _REJECT_COST * (frame[-1] - frame)
    for a, b, cost in steps:
        ahead[b] = min(ahead[b], ahead[a] + cost)
    for a, b, cost in reversed(steps):
        back[a] = min(back[a], back[b] + cost)
    return np.asarray(ahead + back)
