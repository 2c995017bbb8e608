"""The path and the landmarks that a run's rows and labels say, for loop closing between two rounds.

The problem is that of `slam map` with the labels as identifiers, under Huber's loss, so that rows
count less which contradict all others.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.slam.mapping.graph import Estimate, graph_of_recording
from redetect.slam.mapping.graph_terms import Weighting
from redetect.slam.mapping.solve import solve
from redetect.slam.models.measurement import disc_in_map
from redetect.slam.models.motion import chain_steps
from redetect.slam.recording import Recording


class LabelledMap(NamedTuple):
    """Path and landmarks."""

    path: FloatArray  # (N + 1, 3): start and pose after each step; theta is not wrapped
    circle_xy: FloatArray  # (M, 2), by label (m)
    line_xy: FloatArray  # (L, 2), by label (m); NaN where nothing is known


def intersect_bearings(
    recording: Recording,
    path: FloatArray,
    labels: IntArray,
    *,
    camera_xy: tuple[float, float] = (0.0, 0.0),
) -> FloatArray:
    """Places of lines from the bearings of all rows that saw them, the path being known.

    Takes `path` (N + 1, 3), `labels` (n,), `camera_xy` (2,); returns (L, 2).
    """
    lines = recording.lines
    count = int(labels.max(initial=-1)) + 1
    pose = path[lines.frame + 1]
    centre = disc_in_map(pose, np.broadcast_to(np.asarray(camera_xy), (len(pose), 2)))
    angle = lines.bearing_rad + pose[:, 2]
    along = np.stack([np.sin(angle), -np.cos(angle)], axis=-1)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    offset = np.sum(normal * centre, axis=1)
    distance = np.full(len(pose), 3.0)
    places = np.full((count, 2), np.nan)
    for _ in range(4):  # the farther a line, the less its bearing says
        weight = 1.0 / (lines.sigma_rad * np.maximum(distance, 0.3)) ** 2
        information = np.zeros((count, 2, 2))
        np.add.at(information, labels, weight[:, None, None] * normal[:, :, None] * normal[:, None])
        vector = np.zeros((count, 2))
        np.add.at(vector, labels, (weight * offset)[:, None] * normal)
        smallest = np.linalg.eigvalsh(information)[:, 0]
        certain = smallest > 1.0 / 0.5**2
        places[:] = np.nan
        places[certain] = np.linalg.solve(information[certain], vector[certain][..., None])[..., 0]
        ahead = np.sum(along * (places[labels] - centre), axis=1)
        distance = np.where(np.isfinite(ahead), np.abs(ahead), distance)
    behind = np.bincount(labels, ahead < 0.0, minlength=count) > 0
    places[behind] = np.nan
    return places


def solve_path(
    recording: Recording,
    circle_labels: IntArray,
    line_labels: IntArray,
    path: FloatArray | None = None,
    line_xy: FloatArray | None = None,
    *,
    camera_xy: tuple[float, float] = (0.0, 0.0),
    sigma_scale: float = 1.0,
    tolerance: float = 1e-4,
) -> LabelledMap:
    """Least squares over all poses and landmarks, from a path (by default odometry) on.

    Labels count from 0 without gaps. Lines keep near their initial positions `line_xy` (L, 2); rows
    of lines with NaN are ignored, without `line_xy` all. `sigma_scale` is a factor on the discs'
    standard deviations.
    """
    circles, lines = recording.circles, recording.lines
    poses = chain_steps(recording.steps) if path is None else path
    places = np.full((int(line_labels.max(initial=-1)) + 1, 2), np.nan)
    if line_xy is not None:
        places[:] = line_xy
    known = np.isfinite(places[:, 0])
    rows = np.flatnonzero(known[line_labels])
    covariance = sigma_scale**2 * circles.covariance
    labelled = replace(circles, ids=circle_labels, covariance=covariance)
    graph = replace(
        graph_of_recording(replace(recording, circles=labelled)),
        line_ids=np.flatnonzero(known),
        line_pose=lines.frame[rows] + 1,
        bearing_rad=lines.bearing_rad[rows],
        bearing_sigma_rad=lines.sigma_rad[rows],
        member_row=np.arange(len(rows)),
        member_line=(np.cumsum(known) - 1)[line_labels[rows]],
        camera_xy=np.asarray(camera_xy, dtype=np.float64),
        line_prior=places[known],
    )
    seen = disc_in_map(poses[graph.disc_pose], graph.disc_xy)
    totals = [np.bincount(graph.disc_index, seen[:, a], len(graph.disc_ids)) for a in (0, 1)]
    disc_xy = np.stack(totals, axis=-1) / graph.disc_row_counts[:, None]
    start = Estimate(poses, disc_xy, places[known])
    found = solve(graph, start, Weighting(loss="huber"), tolerance=tolerance).estimate
    places[known] = found.line_xy
    return LabelledMap(found.poses, found.disc_xy, places)
