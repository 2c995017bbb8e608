"""Which row shows which disc, where a recording's IDs are wrong.

IDs were given by people: one ID may stand for discs at two places, one disc may have two IDs, a row
may carry its neighbour's. A world with such mistakes shows nothing where a row was seen, so they
are mended before it is rendered.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from camera import Camera
from redetect.slam.mounting import rotation_exp
from tools.arrays import FloatArray, IntArray
from tools.reenactment.fitting import mahalanobis, row_distances
from tools.reenactment.mounted_discs import Geometry, predict_pixels
from tools.reenactment.recording import Recording

#: Discs of the data set have a radius of 0.10 m: two that are nearer than this would overlap.
DISC_DIAMETER_M = 0.2

# How far apart a disc's places may come out in the map when it is seen from some metres away.
_AGREEMENT_M = 0.4


@dataclass(frozen=True, eq=False)
class Mending:
    """A recording and a geometry whose discs are numbered anew."""

    recording: Recording  # The same rows in the same order; some show another disc.
    geometry: Geometry  # Discs merged, and added where rows asked for one.
    merged: int  # Discs that fell to another one, rows that went to a neighbour, discs added.
    reassigned: int
    added: int

    @property
    def changes(self) -> int:
        """How much there was to mend."""
        return self.merged + self.reassigned + self.added


def mend_associations(
    camera: Camera, recording: Recording, geometry: Geometry, *, gate: float = 4.0
) -> Mending:
    """Merge discs that overlap; give stray rows to the disc they show, or to a new one."""
    heir = _merge_overlapping(geometry.disc_xy, recording)
    disc = heir[recording.disc]

    distance = row_distances(camera, replace(recording, disc=disc), geometry)
    reassigned, strays = 0, []
    for row in np.flatnonzero(distance > gate):
        shown = _disc_shown(camera, recording, geometry, disc, int(row), gate)
        if shown is None:
            strays.append(int(row))
        else:
            disc[row] = shown
            reassigned += 1

    disc_xy, disc_ids = geometry.disc_xy, recording.disc_ids
    places = map_positions(camera, recording, geometry, np.array(strays, dtype=np.int64))
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
        recording=replace(recording, disc_ids=disc_ids[kept], disc=renumbered[disc]),
        geometry=replace(geometry, disc_xy=disc_xy[kept]),
        merged=int(np.sum(heir != np.arange(len(heir)))),
        reassigned=reassigned,
        added=added,
    )


def map_positions(
    camera: Camera, recording: Recording, geometry: Geometry, rows: IntArray
) -> FloatArray:
    """Where in the map rows saw their discs, through the camera as mounted and tilted.
    Returns (len(rows), 2).
    """
    frame = recording.frame[rows]
    tilt = np.concatenate([geometry.tilt[frame], np.zeros((len(frame), 1))], axis=1)
    turn, _ = rotation_exp(tilt)
    direction = np.einsum(
        "nij,nj->ni", turn @ geometry.rotation, camera.unproject(recording.pixels[rows])
    )
    down = np.where(direction[:, 2] < 0.0, direction[:, 2], np.nan)
    floor = geometry.centre[:2] - (geometry.centre[2] / down)[:, None] * direction[:, :2]
    pose = geometry.poses[frame]
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    offset = np.stack(
        [cos * floor[:, 0] - sin * floor[:, 1], sin * floor[:, 0] + cos * floor[:, 1]], axis=1
    )
    return np.asarray(pose[:, :2] + offset)


def _merge_overlapping(disc_xy: FloatArray, recording: Recording) -> IntArray:
    """For each disc itself, or the oftener seen one that it overlaps and is never seen beside."""
    heir = np.arange(len(disc_xy))
    sightings = np.bincount(recording.disc, minlength=len(disc_xy))
    pairs = cKDTree(disc_xy).query_pairs(DISC_DIAMETER_M, output_type="ndarray")
    distance = np.linalg.norm(disc_xy[pairs[:, 0]] - disc_xy[pairs[:, 1]], axis=1)
    for a, b in pairs[np.argsort(distance, kind="stable")]:
        together = np.intersect1d(
            recording.frame[recording.disc == a], recording.frame[recording.disc == b]
        )
        if heir[a] == a and heir[b] == b and together.size == 0:
            keep, drop = (a, b) if sightings[a] >= sightings[b] else (b, a)
            heir[heir == drop] = keep
    return heir


def _disc_shown(
    camera: Camera, recording: Recording, geometry: Geometry, disc: IntArray, row: int, gate: float
) -> int | None:
    """The disc nearest to a row within the gate that no other row of its frame shows."""
    frame = recording.frame[row]
    taken = disc[recording.frame == frame]
    candidates = np.setdiff1d(disc, taken)
    pixels, _ = predict_pixels(camera, geometry, np.full(len(candidates), frame), candidates)
    covariance = np.broadcast_to(recording.row_covariance[row], (len(candidates), 2, 2))
    distance = mahalanobis(camera, pixels, recording.row_xy[row], covariance)
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
