"""A robot's poses over a session: every time's pose, decided by its neighbours, and an account."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.geometry.covariance import planar_covariance
from redetect.groundtruth.geometry.transforms import heading
from redetect.groundtruth.markers.calibration import Network, Rig
from redetect.groundtruth.markers.neighbours import Choice, choose_candidates
from redetect.groundtruth.markers.poses import PoseCandidate, PoseEstimate, estimate_pose
from redetect.groundtruth.markers.session import (
    MarkerFrame,
    View,
    group_by_time,
    pose_problem,
    rig_views,
)
from redetect.groundtruth.markers.settings import PoseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses

FloatArray = NDArray[np.float64]
Status = Literal["clear", "resolved", "unresolved", "rejected", "failed", "unseen"]

STATUSES: tuple[Status, ...] = (
    "clear",
    "resolved",
    "unresolved",
    "rejected",
    "failed",
    "unseen",
)


@dataclass(frozen=True, eq=False)
class TrackedTime:
    """Result for one time.

    Attributes
    ----------
    time_s : float
        Mean of the images' times that show a marker of the rig.
    images : tuple of MarkerFrame
    views : tuple of View
        The rig's markers in them.
    status : str
        `clear`, or `resolved` by the neighbours: there is a pose. `unresolved`: several poses are
        possible; `rejected`: what was seen does not fit the times before and after; `failed`: no
        pose explains the corners; `unseen`: no marker of the rig in any image.
    estimate : PoseEstimate or None
    choice : Choice or None
    reason : str
        Why there is no pose, or a remark on it.
    """

    time_s: float
    images: tuple[MarkerFrame, ...]
    views: tuple[View, ...]
    status: Status
    estimate: PoseEstimate | None = None
    choice: Choice | None = None
    reason: str = ""

    @property
    def pose(self) -> PoseCandidate | None:
        """The robot's pose; None if there is no reliable one."""
        if self.status in ("clear", "resolved") and self.estimate is not None:
            assert self.choice is not None
            assert self.choice.candidate is not None
            return self.estimate.candidates[self.choice.candidate]
        return None


@dataclass(frozen=True, eq=False)
class Track:
    """A robot's poses over time.

    Attributes
    ----------
    times : tuple of TrackedTime
    unknown_markers : int
        Markers found in the images that are not on the rig.
    """

    times: tuple[TrackedTime, ...]
    unknown_markers: int

    @property
    def posed(self) -> list[tuple[float, PoseCandidate]]:
        """Times with a pose."""
        return [(t.time_s, t.pose) for t in self.times if t.pose is not None]

    @property
    def counts(self) -> dict[Status, int]:
        """How many times ended how."""
        return {status: sum(t.status == status for t in self.times) for status in STATUSES}

    @property
    def reduced_cost(self) -> float:
        """Sum of all costs over their degrees of freedom: 1 if the covariances are right."""
        refined = [pose.refined for _, pose in self.posed]
        freedom = sum(pose.degrees_of_freedom for pose in refined)
        return sum(pose.cost for pose in refined) / freedom if freedom else float("nan")

    def planar(self) -> PlanarPoses:
        """The poses on the floor with their covariances."""
        posed = self.posed
        if not posed:
            return PlanarPoses(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
        poses = np.stack([pose.world_from_robot for _, pose in posed])
        covariances = np.stack([pose.covariance for _, pose in posed])
        return PlanarPoses(
            np.array([time for time, _ in posed]),
            np.column_stack([poses[:, 0, 3], poses[:, 1, 3], heading(poses)]),
            planar_covariance(poses, covariances),
        )


def track_robot(
    frames: Sequence[MarkerFrame],
    rig: Rig,
    network: Network,
    settings: PoseSettings,
    on_progress: Callable[[], None] | None = None,
    on_count: Callable[[int], None] | None = None,
) -> Track:
    """Work out the robot's poses from the markers found in a session's images.

    Parameters
    ----------
    frames : sequence of MarkerFrame
        Of all cameras, their indices those of `network`.
    rig : Rig
    network : Network
    settings : PoseSettings
    on_progress : callable, optional
        Called after each time.
    on_count : callable, optional
        Called first, with the number of times.

    Returns
    -------
    Track
    """
    groups = group_by_time(frames, settings.time_tolerance_s)
    if on_count is not None:
        on_count(len(groups))
    tracked: list[TrackedTime] = []
    unknown = 0
    for group in groups:
        views = tuple(rig_views(group, rig))
        unknown += sum(len(frame.markers) for frame in group) - len(views)
        tracked.append(_estimated(group, views, rig, network, settings))
        if on_progress is not None:
            on_progress()
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
    estimate, choice = tracked.estimate, tracked.choice
    chosen = None
    if estimate is not None:
        chosen = estimate.candidates[
            choice.candidate if choice is not None and choice.candidate is not None else 0
        ]
        entry["ambiguous"] = estimate.ambiguous
        entry["contradiction"] = estimate.contradiction
        if choice is not None and estimate.ambiguous:
            entry["margin"] = round(choice.margin, 3)
        entry["candidates"] = [
            {
                "x_y_theta": [
                    round(float(v), 6)
                    for v in (
                        *candidate.world_from_robot[:2, 3],
                        heading(candidate.world_from_robot),
                    )
                ],
                "z_m": round(float(candidate.world_from_robot[2, 3]), 6),
                "rms_px": round(candidate.refined.rms_px, 4),
                "cost": round(candidate.refined.cost, 3),
                "degrees_of_freedom": candidate.refined.degrees_of_freedom,
                "log_odds_against": round(odds, 3),
            }
            for candidate, odds in zip(estimate.candidates, estimate.log_odds)
        ]
    entry["markers"] = [
        {"camera": network.names[view.frame.camera], "id": view.marker.id} for view in tracked.views
    ]
    if chosen is not None:
        used = np.flatnonzero(chosen.views)
        for marker, is_used in zip(entry["markers"], chosen.views):
            marker["used"] = bool(is_used)
        for position, index in enumerate(used):
            entry["markers"][index]["error"] = round(float(chosen.refined.view_errors[position]), 3)
            entry["markers"][index]["rms_px"] = round(
                float(chosen.refined.view_rms_px[position]), 4
            )
    return entry


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
        return TrackedTime(time_s, group, views, "unseen")
    try:
        estimate = estimate_pose(pose_problem(views, rig, network, settings), settings)
    except GeometryError as error:
        return TrackedTime(time_s, group, views, "failed", reason=str(error))
    return TrackedTime(time_s, group, views, "unresolved", estimate)


def _decided(tracked: TrackedTime, choice: Choice) -> TrackedTime:
    estimate = tracked.estimate
    assert estimate is not None
    kind = "contradicting markers" if estimate.contradiction else "planar ambiguity"
    reason = ""
    if choice.status == "rejected":
        reason = "does not fit the times before and after"
    elif choice.status == "resolved":
        reason = f"{kind}, decided by the neighbours"
    elif choice.status == "unresolved":
        reason = f"{kind}, not decided by the neighbours"
    return TrackedTime(
        tracked.time_s,
        tracked.images,
        tracked.views,
        choice.status,
        estimate,
        choice,
        reason,
    )
