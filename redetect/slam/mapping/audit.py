"""Finds rows of discs whose identifier contradicts the rest of a run, and their true landmark.

Suspects are the rows that a robust map rejects. Each of them is then compared with the map of the
others: the squared error of measurements added to a least-squares problem is
``r^T (I + J P J^T)^-1 r`` with r and J their whitened errors and Jacobians and P the covariance
before (Y. Bar-Shalom, X. Li, T. Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, section 5.4). The same number decides whether another landmark, or a new one,
explains rows better.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.sparse.linalg import SuperLU
from scipy.special import chdtri

from camera import Camera
from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import CircleLandmark, Row
from redetect.least_squares.solver import factor, whitening
from redetect.plane import apply
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph, graph_of_recording
from redetect.slam.mapping.graph_terms import Weighting, errors, linearise
from redetect.slam.mapping.run_map import ChiSquared, chi_squared, map_run
from redetect.slam.mapping.solve import equations_at, solve
from redetect.slam.recording import UNKNOWN_ID, Recording

Kind = Literal["exchange", "split", "drop"]

# Scale of the robust loss, standard deviations.
_LOSS_SCALE = 3.0
# Rows whose squared error in the robust map is this share of the gate are suspects.
_SUSPECT_SHARE = 0.25
# Rows of an identifier farther apart than this belong to different groups (frames).
_LONGEST_GAP = 10
# Largest distance of a landmark that is tried from a group (m).
_NEAR_M = 1.0
# Rows are explained by a landmark unless their squared error is less probable than this.
_LEAST_PROBABILITY = 1e-3


@dataclass(frozen=True, eq=False)
class Group:
    """Rows of one identifier in neighbouring frames that contradict the rest."""

    rows: IntArray  # (k,): indices of the rows among the recording's discs
    id: int  # their identifier in the file
    kind: Kind  # whether they show another landmark, a new one, or nothing that is known
    new_id: int  # that landmark; -1 for `drop`
    xy: FloatArray  # (k, 2): positions of the rows in the map (m)
    own_m: float  # distance of their median from the landmark of that identifier
    row_chi_squared: FloatArray  # (k,): of each row against the map without all suspects
    # Squared errors of all rows together, as the file has them and with `new_id`; NaN for `drop`.
    chi_squared: float
    mended_chi_squared: float


@dataclass(frozen=True, eq=False)
class Audit:
    """Contradicting rows; chi-squared with all rows, without those, with corrected identifiers."""

    groups: tuple[Group, ...]  # by frame
    before: ChiSquared
    dropped: ChiSquared
    mended: ChiSquared


@dataclass(frozen=True, eq=False)
class _Fit:
    """A least-squares map, with the factor of its normal equations."""

    graph: Graph
    estimate: Estimate
    weighting: Weighting
    information: SuperLU
    table: ChiSquared


def audit_run(
    recording: Recording,
    camera: Camera | None = None,
    *,
    calibrate: bool = False,
    gate: float = 100.0,
    name: str = "run",
) -> Audit:
    """Find the rows whose identifier contradicts the rest."""
    if len(recording.lines):
        raise SlamError(f"{name}: has lines: expected discs, the only ones that are audited")
    plain = Weighting(calibrate=calibrate, row_errors="recorded")
    loss = replace(plain, loss="geman-mcclure", loss_scale=_LOSS_SCALE)
    before = map_run(recording, camera, plain, name=name).table
    robust = map_run(recording, camera, loss, name=name)
    ids = recording.circles.ids.copy()
    known = np.flatnonzero(recording.circles.identified)
    squared = np.sum(errors(robust.graph, robust.estimate, plain).discs ** 2, axis=1)
    suspects = known[squared > _SUSPECT_SHARE * gate]
    if len(suspects) == len(known):
        raise SlamError(f"{name}: no row is certain with gate {gate:g}: expected a larger one")
    trusted = ids.copy()
    trusted[suspects] = UNKNOWN_ID
    fit = _fit(recording, trusted, robust.estimate, camera, plain)
    score = {
        int(k): _misfit(recording, fit, np.array([k]), int(ids[k]))
        for k in suspects
        if ids[k] in fit.graph.disc_ids
    }
    accused = np.array([k for k, value in score.items() if value > gate], dtype=np.int64)
    ids[accused] = UNKNOWN_ID
    fit = _fit(recording, ids, fit.estimate, camera, plain)
    dropped = fit.table

    groups = []
    # The largest groups first, since smaller ones may show the same landmark.
    for rows in sorted(_groups(recording, accused), key=lambda rows: (-len(rows), rows[0])):
        group = _explained(recording, fit, rows, np.array([score[int(k)] for k in rows]))
        groups.append(group)
        if group.new_id != UNKNOWN_ID:
            ids[rows] = group.new_id
            fit = _fit(recording, ids, fit.estimate, camera, plain)
    return Audit(tuple(sorted(groups, key=lambda g: g.rows[0])), before, dropped, fit.table)


def _fit(
    recording: Recording,
    ids: IntArray,
    start: Estimate,
    camera: Camera | None,
    weighting: Weighting,
) -> _Fit:
    """The map with these identifiers; discs start at the median of their rows' positions."""
    circles = replace(recording.circles, ids=ids)
    graph = graph_of_recording(replace(recording, circles=circles), camera)
    places = apply(start.poses[graph.disc_pose], graph.disc_xy)
    order = np.argsort(graph.disc_index, kind="stable")
    parts = np.split(places[order], np.cumsum(graph.disc_row_counts)[:-1])
    first = replace(start, disc_xy=np.array([np.median(part, axis=0) for part in parts]))
    estimate = solve(graph, first, weighting, tolerance=1e-7).at
    information = factor(equations_at(graph, estimate, weighting).matrix)
    table = chi_squared(graph, estimate, weighting, len(recording.lost))
    return _Fit(graph, estimate, weighting, information, table)


def _misfit(
    recording: Recording, fit: _Fit, rows: IntArray, number: int, at: FloatArray | None = None
) -> float:
    """Increase of chi-squared if rows are added to a landmark, a new one near `at` if given."""
    circles, graph, estimate = recording.circles, fit.graph, fit.estimate
    if at is not None:
        graph = replace(graph, disc_ids=np.append(graph.disc_ids, number))
        estimate = replace(estimate, disc_xy=np.vstack([estimate.disc_xy, at]))
    graph = replace(
        graph,
        disc_pose=circles.frame[rows] + 1,
        disc_index=np.searchsorted(graph.disc_ids, np.full(len(rows), number)),
        disc_xy=circles.xy[rows],
        disc_whitening=whitening(circles.covariance[rows]),
    )
    # The camera's mounting is assumed to be known.
    problem = linearise(graph, estimate, fit.weighting)
    first, known = 3 * len(graph.steps), fit.information.shape[0]
    own = slice(first, first + 2 * len(rows))
    by_known, by_new = np.split(problem.jacobian[own].toarray(), [known], axis=1)
    spread = np.eye(len(by_known)) + by_known @ fit.information.solve(by_known.T.copy())
    root = np.linalg.cholesky(spread)
    error = np.linalg.solve(root, problem.residual[own])
    if at is not None:
        by_new = np.linalg.solve(root, by_new)
        error = error - by_new @ np.linalg.lstsq(by_new, error)[0]
    return float(error @ error)


def _groups(recording: Recording, accused: IntArray) -> list[IntArray]:
    """Accused rows of an identifier, without a fitting row or a long gap in between."""
    ids, frame = recording.circles.ids, recording.circles.frame
    guilty = np.zeros(len(ids), dtype=bool)
    guilty[accused] = True
    groups = []
    for number in np.unique(ids[accused]):
        rows = np.flatnonzero(ids == number)
        apart = (np.diff(frame[rows]) > _LONGEST_GAP) | (np.diff(guilty[rows].astype(int)) != 0)
        groups += [part for part in np.split(rows, np.flatnonzero(apart) + 1) if guilty[part[0]]]
    return groups


def _explained(recording: Recording, fit: _Fit, rows: IntArray, score: FloatArray) -> Group:
    """The best explanation of the rows of a group."""
    circles, graph = recording.circles, fit.graph
    number = int(circles.ids[rows[0]])
    xy = apply(fit.estimate.poses[circles.frame[rows] + 1], circles.xy[rows])
    place = np.median(xy, axis=0)
    away = np.linalg.norm(fit.estimate.disc_xy - place, axis=1)
    # A landmark appears once in a frame.
    taken = graph.disc_index[np.isin(graph.disc_pose, circles.frame[rows] + 1)]
    free = np.setdiff1d(np.flatnonzero(away < _NEAR_M), taken)
    others = {int(k): _misfit(recording, fit, rows, int(k)) for k in graph.disc_ids[free]}
    new_id = min(others, key=others.__getitem__, default=UNKNOWN_ID)
    kind: Kind = "exchange"
    mended = others.get(new_id, np.inf)
    if mended > chdtri(2 * len(rows), _LEAST_PROBABILITY):
        kind, new_id = "split", int(max(circles.ids.max(), graph.disc_ids.max())) + 1
        mended = _misfit(recording, fit, rows, new_id, place)
        if len(rows) == 1 or mended > chdtri(2 * len(rows) - 2, _LEAST_PROBABILITY):
            kind, new_id, mended = "drop", UNKNOWN_ID, np.nan
    return Group(
        rows=rows,
        id=number,
        kind=kind,
        new_id=new_id,
        xy=xy,
        own_m=float(away[np.searchsorted(graph.disc_ids, number)]),
        row_chi_squared=score,
        chi_squared=_misfit(recording, fit, rows, number),
        mended_chi_squared=float(mended),
    )


def audited_rows(rows: Iterable[Row], audit: Audit, apply: str) -> Iterator[Row]:
    """Rows of a file, contradicting ones corrected or dropped, all others unchanged."""
    new_id = {int(k): group.new_id for group in audit.groups for k in group.rows}
    disc = -1
    for row in rows:
        disc += isinstance(row.record, CircleLandmark)
        if not isinstance(row.record, CircleLandmark) or disc not in new_id:
            yield row
        elif apply == "mend":
            yield row.with_record(replace(row.record, ids=(new_id[disc],)))
