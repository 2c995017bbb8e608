"""From a recorded run to its world, in stages each of which begins where the one before ended.

Graph, solver and the model of a tilted, differently mounted camera are those of `slam map`
(`redetect.slam.mapping`). Here are the stages, and what becomes of wrong IDs: they were given by
people, so one ID may stand for discs at two places, one disc may have two IDs, a row may carry its
neighbour's. A world with such mistakes shows nothing where a row was seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from camera import Camera
from redetect.least_squares.solver import whitening
from redetect.plane import apply
from redetect.slam.mapping.graph import Estimate, Graph, first_sight
from redetect.slam.mapping.graph_terms import Weighting, errors
from redetect.slam.mapping.solve import solve
from redetect.slam.models import disc_in_robot
from redetect.slam.mounting import (
    directions_of_rows,
    mounting_change,
    nominal_mounting,
    rotation_exp,
    rows_as_recorded,
)
from tools.arrays import FloatArray, IntArray

#: A row counts as found again within so many standard deviations of its shipped covariance.
GATE_SIGMA = 4.0
#: Discs of the data set have a radius of 0.10 m: two that are nearer than this would overlap.
DISC_DIAMETER_M = 0.2
# How far apart a disc's places may come out in the map when it is seen from some metres away.
_AGREEMENT_M = 0.4

_LEAST_SQUARES = Weighting(calibrate=True, row_errors="recorded")
_ROBUST = replace(_LEAST_SQUARES, loss="geman-mcclure", loss_scale=4.0)
# What is rendered has to look right in every frame, near discs (whose published covariance is
# worth many pixels) included: so errors count in pixels, odometry counts little, and each frame
# has a tilt. The figures were chosen for the share of rows that come out inside the image's tables.
_AS_SEEN = replace(_ROBUST, loss_scale=6.0, tilt_sigma_rad=float(np.radians(0.5)))
_PIXEL_SIGMA, _ODOMETRY_FACTOR = 2.0, 8.0
_FINE, _FINEST = 1e-6, 1e-9
_MOST_STEPS = 300
_MOST_MENDINGS = 10


@dataclass(frozen=True)
class Quality:
    """How well an estimate explains a recording."""

    chi_squared: float  # Of odometry and the rows in sight, under the file's own covariances.
    out_of_sight: int  # Rows whose disc lies where the camera can't see it.
    mounting: FloatArray
    """(4,) Rotation vector from calibrated to true mounting (robot frame, radians), and true minus
    calibrated height (metres)."""
    tilt_deg: FloatArray  # (2,) Root mean square of pitch and roll, degrees.
    share: float  # Of rows predicted within `GATE_SIGMA`.
    share_whole_pixel: float
    """The same after rounding the predictions to whole pixels, as the published detector does."""
    median_px: float  # Median distance of the rows' pixels from the predicted ones.


class Stage(NamedTuple):
    """An estimate on the way, and the recording as mended so far."""

    label: str
    graph: Graph
    estimate: Estimate  # With mounting and tilt.


def nominal(camera: Camera, poses: FloatArray, disc_xy: FloatArray) -> Estimate:
    """An estimate with the camera mounted as calibrated and the robot upright.
    `poses` (N + 1, 3); `disc_xy` (M, 2).
    """
    upright = np.zeros((len(poses), 2))
    return Estimate(poses, disc_xy, np.zeros((0, 2)), nominal_mounting(camera), upright)


def predicted_rows(graph: Graph, estimate: Estimate, pose: IntArray, disc: IntArray) -> FloatArray:
    """(n, 2) rows as the calibrated camera would put discs seen from poses on the floor.
    `pose`, `disc` (n,) are indices; NaN where the camera, as mounted and tilted, sees no disc.
    """
    camera, mounting, tilt = graph.camera, estimate.mounting, estimate.tilt
    assert camera is not None
    assert mounting is not None
    assert tilt is not None
    in_robot = disc_in_robot(estimate.poses[pose], estimate.disc_xy[disc])
    rows, _ = rows_as_recorded(camera, in_robot, mounting, tilt[pose])
    return np.where(np.isfinite(camera.project_floor(rows)), rows, np.nan)


def row_distances(graph: Graph, estimate: Estimate) -> FloatArray:
    """(n,) Mahalanobis distances of predicted from recorded rows; infinite where none is seen."""
    rows = predicted_rows(graph, estimate, graph.disc_pose, graph.disc_index)
    return _distances(rows - graph.disc_xy, graph.disc_whitening)


def _distances(error: FloatArray, whiten: FloatArray) -> FloatArray:
    distance = np.linalg.norm(np.einsum("nij,nj->ni", whiten, error), axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def assess(graph: Graph, estimate: Estimate) -> Quality:
    """Measure how well an estimate explains a recording."""
    camera = graph.camera
    assert camera is not None
    assert estimate.mounting is not None
    assert estimate.tilt is not None
    rows = predicted_rows(graph, estimate, graph.disc_pose, graph.disc_index)
    pixels = camera.project_floor(rows)
    distance = _distances(rows - graph.disc_xy, graph.disc_whitening)
    rounded = camera.floor_from_pixel(np.round(pixels))
    whole = _distances(rounded - graph.disc_xy, graph.disc_whitening)
    seen = np.isfinite(distance)
    odometry = errors(graph, estimate, _LEAST_SQUARES).odometry
    off_px = np.linalg.norm(pixels - camera.project_floor(graph.disc_xy), axis=1)
    return Quality(
        chi_squared=float(np.sum(distance[seen] ** 2) + np.sum(odometry**2)),
        out_of_sight=int(np.sum(~seen)),
        mounting=mounting_change(camera, estimate.mounting),
        tilt_deg=np.degrees(np.sqrt(np.mean(estimate.tilt[1:] ** 2, axis=0))),
        share=float(np.mean(distance <= GATE_SIGMA)),
        share_whole_pixel=float(np.mean(whole <= GATE_SIGMA)),
        median_px=float(np.median(off_px[seen])),
    )


def refit(
    graph: Graph, start: Estimate, weighting: Weighting, tolerance: float = _FINEST
) -> Estimate:
    """Fit an estimate to a recording, until a step lowers the cost by less than `tolerance` of it.

    Rows whose disc is out of sight at the start pull nothing, and discs of no other rows stay where
    they are. Mounting and tilt stay, too, unless they are unknowns of the weighting.
    """
    seen = np.isfinite(row_distances(graph, start))
    discs, index = np.unique(graph.disc_index[seen], return_inverse=True)
    in_sight = replace(
        graph, disc_ids=graph.disc_ids[discs], disc_pose=graph.disc_pose[seen],
        disc_index=index.astype(np.int64), disc_xy=graph.disc_xy[seen],
        disc_whitening=graph.disc_whitening[seen],
    )  # fmt: skip
    begin = replace(
        start, disc_xy=start.disc_xy[discs],
        mounting=start.mounting if weighting.calibrate else None,
        tilt=start.tilt if weighting.tilt_sigma_rad else None,
    )  # fmt: skip
    found = solve(in_sight, begin, weighting, tolerance=tolerance, most_steps=_MOST_STEPS).estimate
    disc_xy = start.disc_xy.copy()
    disc_xy[discs] = found.disc_xy
    mounting = start.mounting if found.mounting is None else found.mounting
    tilt = start.tilt if found.tilt is None else found.tilt
    return replace(found, disc_xy=disc_xy, mounting=mounting, tilt=tilt)


def _as_seen(graph: Graph) -> Graph:
    """The same rows with the covariance of pixels, and odometry that counts little."""
    camera = graph.camera
    assert camera is not None
    by_pixel = _PIXEL_SIGMA * camera.floor_jacobian(camera.project_floor(graph.disc_xy))
    return replace(
        graph, disc_whitening=whitening(by_pixel @ np.swapaxes(by_pixel, 1, 2)),
        step_whitening=graph.step_whitening / _ODOMETRY_FACTOR,
    )  # fmt: skip


def stages(graph: Graph) -> Iterator[Stage]:
    """Fit a world to a recording, better with each stage: the map of `slam map` is the first."""
    assert graph.camera is not None
    plain = solve(graph, first_sight(graph), Weighting()).estimate
    at = nominal(graph.camera, plain.poses, plain.disc_xy)
    yield Stage("least squares, nominal mounting", graph, at)
    at = refit(graph, at, _LEAST_SQUARES)
    yield Stage("least squares, true mounting", graph, at)
    at = refit(graph, at, _ROBUST, _FINE)
    yield Stage("robust, true mounting", graph, at)
    at = refit(_as_seen(graph), at, _AS_SEEN, _FINE)
    yield Stage("in pixels, tilting robot", graph, at)
    for _ in range(_MOST_MENDINGS):
        mending = mend_associations(graph, at)
        if not mending.changes:
            break
        graph = mending.graph
        at = refit(_as_seen(graph), mending.estimate, _AS_SEEN, _FINE)
    else:
        raise ValueError(f"rows change their discs after {_MOST_MENDINGS} rounds still")
    yield Stage("IDs mended", graph, at)


class Mending(NamedTuple):
    """A recording and an estimate whose discs are numbered anew."""

    graph: Graph  # The same rows in the same order; some show another disc.
    estimate: Estimate  # Discs merged, and added where rows asked for one.
    merged: int  # Discs that fell to another one.
    reassigned: int  # Rows that went to a neighbour.
    added: int  # Discs added.

    @property
    def changes(self) -> int:
        """How much there was to mend."""
        return self.merged + self.reassigned + self.added


def mend_associations(graph: Graph, estimate: Estimate, gate: float = GATE_SIGMA) -> Mending:
    """Merge discs that overlap; give stray rows to the disc they show, or to a new one."""
    heir = _merge_overlapping(graph, estimate.disc_xy)
    disc = heir[graph.disc_index]

    distance = row_distances(replace(graph, disc_index=disc), estimate)
    reassigned, strays = 0, []
    for row in np.flatnonzero(distance > gate):
        shown = _disc_shown(graph, estimate, disc, int(row), gate)
        if shown is None:
            strays.append(int(row))
        else:
            disc[row] = shown
            reassigned += 1

    disc_xy, disc_ids = estimate.disc_xy, graph.disc_ids
    places = map_positions(graph, estimate, np.array(strays, dtype=np.int64))
    added = 0
    for rows, place in _clusters(strays, places, disc):
        if np.min(np.linalg.norm(disc_xy[np.unique(disc)] - place, axis=1)) >= DISC_DIAMETER_M:
            disc_ids = np.append(disc_ids, disc_ids[disc[rows[0]]])
            disc[rows] = len(disc_xy)
            disc_xy = np.concatenate([disc_xy, place[None]])
            added += 1

    kept = np.unique(disc)
    kept = kept[np.argsort(disc_ids[kept], kind="stable")]
    renumbered = np.zeros(len(disc_xy), dtype=np.int64)
    renumbered[kept] = np.arange(len(kept))
    return Mending(
        replace(graph, disc_ids=disc_ids[kept], disc_index=renumbered[disc]),
        replace(estimate, disc_xy=disc_xy[kept]),
        merged=int(np.sum(heir != np.arange(len(heir)))),
        reassigned=reassigned,
        added=added,
    )


def map_positions(graph: Graph, estimate: Estimate, rows: IntArray) -> FloatArray:
    """(len(rows), 2) where in the map rows saw their discs, the camera as mounted and tilted."""
    camera, mounting, tilt = graph.camera, estimate.mounting, estimate.tilt
    assert camera is not None
    assert mounting is not None
    assert tilt is not None
    pose = graph.disc_pose[rows]
    turn, _ = rotation_exp(np.column_stack([tilt[pose], np.zeros(len(pose))]))
    turn = turn @ mounting[:, :3] @ np.linalg.inv(camera.rotation)
    ray = np.einsum("nij,nj->ni", turn, directions_of_rows(camera, graph.disc_xy[rows]))
    down = np.where(ray[:, 2] < 0.0, ray[:, 2], np.nan)
    floor = mounting[:2, 3] - (mounting[2, 3] / down)[:, None] * ray[:, :2]
    return apply(estimate.poses[pose], floor)


def _merge_overlapping(graph: Graph, disc_xy: FloatArray) -> IntArray:
    """For each disc itself, or the oftener seen one that it overlaps and is never seen beside."""
    heir = np.arange(len(disc_xy))
    sightings = np.bincount(graph.disc_index, minlength=len(disc_xy))
    pairs = KDTree(disc_xy).query_pairs(DISC_DIAMETER_M, output_type="ndarray")
    distance = np.linalg.norm(disc_xy[pairs[:, 0]] - disc_xy[pairs[:, 1]], axis=1)
    for a, b in pairs[np.argsort(distance, kind="stable")]:
        frames = (graph.disc_pose[graph.disc_index == disc] for disc in (a, b))
        if heir[a] == a and heir[b] == b and np.intersect1d(*frames).size == 0:
            keep, drop = (a, b) if sightings[a] >= sightings[b] else (b, a)
            heir[heir == drop] = keep
    return heir


def _disc_shown(
    graph: Graph, estimate: Estimate, disc: IntArray, row: int, gate: float
) -> int | None:
    """The disc nearest to a row within the gate that no other row of its frame shows."""
    pose = graph.disc_pose[row]
    candidates = np.setdiff1d(disc, disc[graph.disc_pose == pose])
    rows = predicted_rows(graph, estimate, np.full(len(candidates), pose), candidates)
    distance = _distances(rows - graph.disc_xy[row], graph.disc_whitening[[row] * len(rows)])
    if distance.size == 0 or distance.min() > gate:
        return None
    return int(candidates[np.argmin(distance)])


def _clusters(
    rows: list[int], places: FloatArray, disc: IntArray
) -> list[tuple[list[int], FloatArray]]:
    """Strays of one ID whose places agree, if two or more do, with their mean place."""
    clusters: list[list[int]] = []
    for k in np.flatnonzero(np.all(np.isfinite(places), axis=1)):
        for members in clusters:
            same = disc[rows[members[0]]] == disc[rows[k]]
            if same and np.linalg.norm(places[members].mean(axis=0) - places[k]) < _AGREEMENT_M:
                members.append(int(k))
                break
        else:
            clusters.append([int(k)])
    return [([rows[k] for k in m], places[m].mean(axis=0)) for m in clusters if len(m) > 1]
