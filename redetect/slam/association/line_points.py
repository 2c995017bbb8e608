"""Associates rows of verticals along a known path, by points where rays intersect.

A row of a vertical is a ray in the map. From frame to frame it is ambiguous: neighbouring edges are
closer together than the uncertainty of a bearing, and a new edge may be at any distance. Over many
frames the rays of one vertical intersect in one point, which becomes less likely by chance with
each frame. So at each intersection of rays of frames a few steps apart, the likelihood of the
surrounding frames with a vertical there is compared with that without. The best point is assigned
its rows, at most one per frame; then the next best point among the remaining rows. This is a greedy
solution of what multiple hypothesis tracking solves with trees (D. B. Reid, "An algorithm for
tracking multiple targets", IEEE Transactions on Automatic Control 24(6), 1979).

The path comes from the discs; it gives the heading of a single frame less precisely than a bearing
is measured. So the verticals associated from frame to frame are added to the least-squares problem
of the path first, with a robust loss. The search then starts with wide gates; its result replaces
those verticals in the problem, and the search is repeated with narrower gates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import wrap_angle
from redetect.slam.association.line_points_kernels import Rays, Search, crossings, take_points
from redetect.slam.association.loop_path import intersect_bearings, solve_path
from redetect.slam.errors import SlamError
from redetect.slam.models.measurement import bearing_of_vertical, disc_in_map
from redetect.slam.recording import Recording
from redetect.storage.bounds import ABOVE_0, PROBABILITY, demand, whole

# How far beyond the field of view a bearing may be.
_WIDER_RAD = 0.005
# Number of times that the frame-to-frame association corrects the path.
_FIRST_ROUNDS = 2


@dataclass(frozen=True)
class PointSettings:
    """Settings of the search for points."""

    # Standard deviation of the path's heading in a single frame, for each round (degrees).
    heading_sigma_deg: tuple[float, ...] = (0.2, 0.15, 0.1, 0.1)
    # Factor on the rows' standard deviations, which do not include the detector's errors at edges
    # that are close together.
    sigma_scale: float = 1.5
    path_sigma_scale: float = 2.0  # the same factor for rows that correct the path
    detected: float = 0.7  # probability that a vertical in view gives a row
    gate_sigmas: float = 3.0  # a ray that passes farther from a point does not support it
    least_score: float = 4.0  # least log likelihood ratio of the rows with a point to those without
    # Numbers of steps between frames whose rays are intersected.
    gaps: tuple[int, ...] = (2, 4, 7, 11)
    least_parallax_sigmas: float = 4.0  # least angle between two rays that are intersected
    farthest_m: float = 14.0  # intersections farther away are ignored
    window_frames: int = 40  # number of frames before and after an intersection that are scored
    path_rows: int = 6  # points of fewer rows do not correct the path

    def __post_init__(self) -> None:
        demand(
            self,
            SlamError,
            heading_sigma_deg=ABOVE_0,
            sigma_scale=ABOVE_0,
            path_sigma_scale=ABOVE_0,
            detected=PROBABILITY,
            gate_sigmas=ABOVE_0,
            least_score=ABOVE_0,
            gaps=whole(1),
            least_parallax_sigmas=ABOVE_0,
            farthest_m=ABOVE_0,
            window_frames=whole(1),
            path_rows=whole(1),
        )


def lines_by_points(
    recording: Recording,
    path: FloatArray,
    circle_labels: IntArray,
    line_labels: IntArray,
    settings: PointSettings | None = None,
    *,
    camera_xy: tuple[float, float] = (0.0, 0.0),
    disc_sigma_scale: float = 1.0,
) -> tuple[IntArray, FloatArray]:
    """Labels of the rows of verticals, by the points in which they meet.

    Takes `path` (N + 1, 3), `circle_labels` (n,), `line_labels` (m,), `camera_xy` (2,); returns
    `labels` (m,), `path` (N + 1, 3).
    """
    setting = settings or PointSettings()
    for _ in range(_FIRST_ROUNDS):
        places = intersect_bearings(recording, path, line_labels, camera_xy=camera_xy)
        known = np.isfinite(places[:, 0])
        if not np.any(known):
            break
        label_of = np.where(known, np.cumsum(known) - 1, -1)
        path = _path_with_points(
            recording,
            path,
            circle_labels,
            label_of[line_labels],
            places[known],
            setting,
            camera_xy,
            disc_sigma_scale,
        )
    labels = np.full(len(line_labels), -1, dtype=np.int64)
    last = len(setting.heading_sigma_deg) - 1
    for number, sigma_deg in enumerate(setting.heading_sigma_deg):
        rays = rays_of(recording, path, camera_xy, setting.sigma_scale, np.radians(sigma_deg))
        labels, points = find_points(rays, setting)
        if number < last and len(points):
            path = _path_with_points(
                recording, path, circle_labels, labels, points, setting, camera_xy, disc_sigma_scale
            )
    rest = labels < 0
    _, own = np.unique(line_labels[rest], return_inverse=True)
    labels[rest] = labels.max(initial=-1) + 1 + own
    return labels, path


def rays_of(
    recording: Recording,
    path: FloatArray,
    camera_xy: tuple[float, float],
    sigma_scale: float,
    heading_sigma_rad: float,
) -> Rays:
    """The rows of verticals as rays in the map.

    Takes `path` (N + 1, 3), `camera_xy` (2,).
    """
    lines = recording.lines
    row = np.lexsort((lines.bearing_rad, lines.frame))
    frame, bearing = lines.frame[row], lines.bearing_rad[row]
    poses = path[frame + 1]
    return Rays(
        row=row,
        centre=disc_in_map(poses, np.broadcast_to(np.asarray(camera_xy), (len(poses), 2))),
        angle=bearing + poses[:, 2],
        bearing=bearing,
        sigma=np.hypot(sigma_scale * lines.sigma_rad[row], heading_sigma_rad),
        frame=frame,
        start=np.searchsorted(frame, np.arange(len(recording) + 1)),
        heading=np.stack([np.cos(path[1:, 2]), np.sin(path[1:, 2])], axis=1),
        widest_rad=min(float(np.max(np.abs(bearing), initial=0.0)) + _WIDER_RAD, 1.57),
    )


def find_points(rays: Rays, setting: PointSettings) -> tuple[IntArray, FloatArray]:
    """The points in which rays meet, the best first.

    Returns `labels` (n,), `points` (k, 2).
    """
    points, frames = crossings(
        rays,
        np.array(setting.gaps, dtype=np.int64),
        setting.least_parallax_sigmas,
        setting.farthest_m,
    )
    search = Search(
        setting.detected,
        setting.gate_sigmas,
        setting.window_frames,
        setting.least_score,
        float(rays.sigma.max(initial=0.0)),
    )
    taken, found = take_points(points, frames, rays, search)
    labels = np.empty(len(taken), dtype=np.int64)
    labels[rays.row] = taken
    return labels, found


def _path_with_points(
    recording: Recording,
    path: FloatArray,
    circle_labels: IntArray,
    labels: IntArray,
    points: FloatArray,
    setting: PointSettings,
    camera_xy: tuple[float, float],
    disc_sigma_scale: float,
) -> FloatArray:
    """Least squares over poses, discs and points, done again without the rows that are far off."""
    sigma = setting.path_sigma_scale * recording.lines.sigma_rad
    scaled = replace(recording, lines=replace(recording.lines, sigma_rad=sigma))
    count = len(points)
    used = (labels >= 0) & (
        np.bincount(labels + 1, minlength=count + 1)[labels + 1] >= setting.path_rows
    )
    for _ in range(3):
        solution = solve_path(
            scaled,
            circle_labels,
            np.where(used, labels, count),
            path,
            np.concatenate([points, [[np.nan, np.nan]]]),
            camera_xy=camera_xy,
            sigma_scale=disc_sigma_scale,
        )
        path = solution.path
        places = solution.line_xy[np.where(used, labels, 0)]
        bearing = bearing_of_vertical(path[recording.lines.frame + 1], places, camera_xy)
        off = wrap_angle(bearing - recording.lines.bearing_rad)
        used &= np.abs(off) < 4.0 * sigma
    return path
