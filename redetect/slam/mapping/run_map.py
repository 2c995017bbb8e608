"""A run's least-squares map, from its rows to poses and landmarks with covariances.

Includes the chi-squared table of the solution, as in the data set's report.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from camera import Camera
from redetect.array_types import FloatArray
from redetect.landmarks.map_file import LandmarkMap, MapLandmarks, Path2D, no_landmarks
from redetect.least_squares.solver import Minimum
from redetect.plane import apply, fitted
from redetect.slam.errors import SlamError
from redetect.slam.filters.ekf_slam import filtered_poses
from redetect.slam.mapping.graph import (
    Estimate,
    Graph,
    InitialLines,
    first_sight,
    graph_of_recording,
    place_lines,
    well_placed,
    with_lines,
)
from redetect.slam.mapping.graph_terms import Weighting, errors
from redetect.slam.mapping.solve import Marginals, joint_covariance, marginals, solve
from redetect.slam.mapping.solve_gtsam import solve_gtsam
from redetect.slam.mounting import check_rows_fit_camera, levelled_camera, mounting_change
from redetect.slam.options import Map
from redetect.slam.recording import Recording, camera_of_run
from redetect.slam.settings import MOST_FACTOR, Solver

# Parts of a run are connected if they share this many landmarks; one leaves a rotation free.
_FEWEST_SHARED = 2
# Identifiers of parts do not agree if this many landmarks of the same ones, or more, are farther
# apart than this share of their distance from their centre (medians).
_FEWEST_COMPARED, _MOST_OFF = 5, 0.2
# Tolerance before the final optimisation.
_COARSE = 1e-3
# Multiples of the scale of a non-convex loss, from nearly least squares down.
_GRADUATION = tuple(2.0 ** (k / 2) for k in range(8, 0, -1))

Descent = Callable[[Graph, Estimate, Weighting], Minimum[Estimate]]
_coarsely: Descent = partial(solve, tolerance=_COARSE)

#: The joint covariance of more landmarks than this is not written: it would be gigabytes.
MOST_LANDMARKS_TOGETHER = 5000


@dataclass(frozen=True)
class ChiSquared:
    """Squared errors of a map, and their expectation."""

    poses: int  # p: the start and one per step
    landmarks: int  # n: discs and lines
    steps: int  # t: odometry measurements, the start's pose counted as one
    measurements: int  # m: landmark rows used
    odometry: float  # parts of chi-squared
    discs: float
    lines: float
    chi_squared: float  # their sum, by the files' covariances, whatever loss was minimised
    expected: int  # dim(z) - dim(x): numbers measured minus numbers estimated
    factor: float  # chi_squared / expected, of the variances; NaN without redundancy
    root: float  # its root: the factor on the standard deviations


def chi_squared(
    graph: Graph, estimate: Estimate, weighting: Weighting, lost_steps: int = 0
) -> ChiSquared:
    """Tabulate the squared errors of an estimate."""
    error = errors(graph, estimate, weighting)
    parts = (error.odometry, error.discs, error.lines)
    odometry, discs, lines = (float(np.sum(part**2)) for part in parts)
    total = odometry + discs + lines
    poses = len(graph.steps) + 1
    landmarks = len(graph.disc_ids) + len(graph.line_ids)
    # As many numbers of odometry are measured as of poses are estimated; the start is the origin. A
    # lost step contributes practically nothing.
    unknown = 2 * landmarks + len(weighting.unknown_mounting) + 3 * lost_steps
    expected = 2 * len(graph.disc_pose) + len(graph.line_pose) - unknown
    factor = total / expected if expected > 0 else math.nan
    return ChiSquared(
        poses=poses,
        landmarks=landmarks,
        steps=poses,
        measurements=len(graph.disc_pose) + len(graph.line_pose),
        odometry=odometry,
        discs=discs,
        lines=lines,
        chi_squared=total,
        expected=expected,
        factor=factor,
        root=math.sqrt(factor),
    )


def table_lines(table: ChiSquared) -> list[str]:
    """The table as text, its rows in the report's order."""
    redundant = table.expected > 0
    rows = [
        ("poses p", f"{table.poses}"),
        ("landmarks n", f"{table.landmarks}"),
        ("odometry t (with the start)", f"{table.steps}"),
        ("landmark rows m", f"{table.measurements}"),
        ("chi-squared", f"{table.chi_squared:,.2f}"),
        ("expected dim(z) - dim(x)", f"{table.expected:,}"),
        ("factor", f"{table.factor:.2f}" if redundant else "-"),
        ("root of the factor", f"{table.root:.2f}" if redundant else "-"),
    ]
    return [f"{name:<28}{value:>12}" for name, value in rows]


@dataclass(frozen=True)
class LeftOut:
    """Rows and landmarks that a map cannot use, or cannot check."""

    rows_without_id: int
    discs_seen_once: int  # they are in the map, but nothing checks them
    lines_without_parallax: int  # in rows of their own, or whose position is not certain later
    line_rows: int  # rows of these lines
    line_ids: tuple[int, ...]  # their identifiers


@dataclass(frozen=True, eq=False)
class Mounting:
    """A camera's mounting as estimated from the run."""

    change: FloatArray  # (6,): rotation vector (rad) and position (m), true minus calibrated
    covariance: FloatArray  # (6, 6), zero for numbers that were not estimated
    robot_from_camera: FloatArray  # (3, 4)
    gain: float  # decrease of the sum of squares from the mounting that the rows have
    levelled_by: tuple[float, float]  # mean pitch and roll that have levelled the rows (rad)


@dataclass(frozen=True, eq=False)
class MappedRun:
    """A least-squares map and its history."""

    prefixes: tuple[str, ...]  # names of the poses: the start, then the frames
    graph: Graph
    weighting: Weighting
    start: Estimate  # odometry and first sight, without lines
    estimate: Estimate  # the minimum
    covariance: Marginals
    table: ChiSquared
    left_out: LeftOut
    cost: float  # the minimised cost: chi-squared, or less with a robust loss
    steps: int  # total number of steps
    mounting: Mounting | None

    @property
    def landmarks(self) -> LandmarkMap:
        """The map."""
        graph, at, spread = self.graph, self.estimate, self.covariance
        return LandmarkMap(
            discs=MapLandmarks(graph.disc_ids, at.disc_xy, spread.discs, graph.disc_row_counts),
            lines=MapLandmarks(graph.line_ids, at.line_xy, spread.lines, graph.line_row_counts),
        )

    @property
    def path(self) -> Path2D:
        """The poses."""
        return Path2D(self.prefixes, self.estimate.poses, self.covariance.poses)

    @property
    def before(self) -> tuple[LandmarkMap, Path2D]:
        """Discs and poses at first sight, without covariances."""
        graph, zero = self.graph, np.zeros_like(self.covariance.discs)
        discs = MapLandmarks(graph.disc_ids, self.start.disc_xy, zero, graph.disc_row_counts)
        return LandmarkMap(discs, no_landmarks()), Path2D(self.prefixes, self.start.poses)

    def landmarks_jointly(self) -> LandmarkMap:
        """The map with the joint covariance of its landmarks."""
        joint = joint_covariance(self.graph, self.estimate, self.weighting)
        return replace(self.landmarks, joint_covariance=joint)

    def landmarks_to_write(self) -> LandmarkMap:
        """The map with its joint covariance, unless that would be gigabytes."""
        few = len(self.landmarks.discs) + len(self.landmarks.lines) <= MOST_LANDMARKS_TOGETHER
        return self.landmarks_jointly() if few else self.landmarks


def map_run(
    recording: Recording,
    camera: Camera | None = None,
    weighting: Weighting | None = None,
    *,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    solver: Solver = "separable",
    name: str = "run",
) -> MappedRun:
    """Least squares over all poses and landmarks of a run; the first pose is fixed.

    First odometry and discs are fitted, starting from first sight; then lines are triangulated from
    those poses and everything is fitted together; a robust loss and the mounting start from there.

    Rows without an identifier are ignored. The camera, as calibrated, is needed for lines (the
    origin of bearings), and if the mounting is unknown. `start` is the first pose (m, m, rad),
    `solver` that of the final optimisation, `name` that of the run in messages. Raises `SlamError`
    if no row has an identifier, the run is disconnected, or there is no calibration or minimum.
    """
    wanted = weighting or Weighting()
    _check_usable(recording, camera, wanted, name)
    seen_by = camera
    if camera and wanted.calibrate:  # rows do not show what has levelled them
        seen_by = levelled_camera(camera, recording.levelled_by)
    graph = graph_of_recording(recording, seen_by)
    begin = _parts_registered(recording, graph, first_sight(graph, start), name)
    plain_only = not len(recording.lines) and wanted == Weighting() and solver == "separable"
    # First odometry and discs, then with lines.
    minima = [_fitted_to_discs(recording, graph, begin, 1e-10 if plain_only else _COARSE, name)]
    estimate = minima[-1].at
    placed = place_lines(estimate.poses, recording.lines, graph.camera_xy)
    if not len(placed.ids) and not len(graph.disc_ids):
        raise SlamError(
            f"{name}: none of {len(placed.unplaced)} lines has enough parallax in rows of its own: "
            "there is nothing to map"
        )
    graph, estimate, with_them = _with_lines(graph, recording, estimate, placed)
    minima += with_them
    # From there the wanted loss, and last the mounting.
    final: Descent = solve_gtsam
    if solver != "gtsam":
        # A robust loss converges slowly at the end, since reweighting is not Newton's method.
        final = partial(solve, tolerance=1e-10 if wanted.loss == "none" else 1e-7)
    fixed = replace(wanted, calibrate=False)
    stages = [(_coarsely, weighting) for weighting in _on_the_way(fixed)] + [(final, fixed)]
    if wanted.calibrate:
        stages.append((final, wanted))
    for descend, weighting in () if plain_only else stages:
        minima.append(descend(graph, estimate, weighting))
        estimate = minima[-1].at
    covariance, mounting = marginals(graph, estimate, wanted), None
    if camera and estimate.mounting is not None and covariance.mounting is not None:
        mounting = Mounting(
            change=mounting_change(camera, estimate.mounting),
            covariance=covariance.mounting,
            robot_from_camera=estimate.mounting,
            gain=minima[-2].costs[-1] - minima[-1].costs[-1],
            levelled_by=recording.levelled_by,
        )
    return MappedRun(
        prefixes=("start", *recording.prefixes),
        graph=graph,
        weighting=wanted,
        start=begin,
        estimate=estimate,
        covariance=covariance,
        table=chi_squared(graph, estimate, wanted, len(recording.lost)),
        left_out=_left_out(recording, graph, placed),
        cost=minima[-1].costs[-1],
        steps=sum(len(minimum.costs) - 1 for minimum in minima),
        mounting=mounting,
    )


def map_run_by_flags(flags: Map, recording: Recording) -> MappedRun:
    """`map_run` as the flags of `slam map` state, of a run or several joined ones."""
    needs_camera = flags.calibrate or len(recording.lines) > 0
    return map_run(
        recording,
        camera_of_run(flags.run, flags.camera) if needs_camera else None,
        Weighting.of(flags),
        start=flags.start,
        solver=flags.solver,
        name=", ".join(map(str, flags.runs)),
    )


def _fitted_to_discs(
    recording: Recording, graph: Graph, begin: Estimate, tolerance: float, name: str
) -> Minimum[Estimate]:
    """Least squares of odometry and discs.

    If the errors are much larger than their covariances, the start may have been wrong: then also
    from the poses of a filter, and the lower minimum counts.
    """
    minima = []
    try:
        minima.append(solve(graph, begin, Weighting(), tolerance=tolerance))
    except SlamError as raised:
        error = raised
    expected = max(2 * (len(graph.disc_pose) - len(graph.disc_ids)), 1)
    if minima and minima[0].costs[-1] <= MOST_FACTOR * expected:
        return minima[0]
    with suppress(SlamError):
        poses = filtered_poses(recording, begin.poses[0])
        again = _parts_registered(recording, graph, first_sight(graph, poses=poses), name)
        minima.append(solve(graph, again, Weighting(), tolerance=tolerance))
    if not minima:
        raise error
    return min(minima, key=lambda minimum: minimum.costs[-1])


def _parts_registered(recording: Recording, graph: Graph, begin: Estimate, name: str) -> Estimate:
    """An initial estimate with the parts between lost steps registered by their common discs.

    Each part is mapped separately. The first stays; the next is always the part with most discs in
    common with those registered. A part may also be connected by verticals; it then starts from
    odometry. Raises `SlamError` if a part shares fewer than two landmarks with the others.
    """
    lost, discs = recording.lost, len(graph.disc_ids)
    if not len(lost):
        return begin
    part = np.searchsorted(lost, graph.disc_pose - 1, side="right")
    own, index = np.unique(part * discs + graph.disc_index, return_inverse=True)
    alone = replace(graph, disc_ids=own, disc_index=index)
    begun = first_sight(alone, poses=begin.poses)
    found = solve(alone, begun, Weighting(loss="huber"), tolerance=_COARSE).at
    places = np.full((len(lost) + 1, discs, 2), np.nan)
    places[own // discs, own % discs] = found.disc_xy
    lines: list[set[int]] = [set() for _ in places]
    of_rows = np.searchsorted(lost, recording.lines.frame, side="right")
    for k, ids in zip(of_rows, recording.lines.ids):
        lines[k].update(ids)
    poses, xy, known = found.poses, places[0], lines[0]
    waiting = set(range(1, len(places)))
    while waiting:
        shared = {k: np.isfinite(xy + places[k])[:, 0] for k in waiting}
        counts = {k: np.array([shared[k].sum(), len(known & lines[k])]) for k in waiting}
        k = max(waiting, key=lambda k: (counts[k][0] >= _FEWEST_SHARED, *counts[k]))
        if counts[k].sum() < _FEWEST_SHARED:
            first = min(waiting)
            step = int(lost[first - 1])
            remedy = "" if step else ", or zeros as the covariance of a first step that is unknown"
            raise SlamError(
                f"{name}: disconnected at step {step + 1} ({recording.prefixes[step]}): odometry "
                "is lost or another run begins there, and the parts before and after share "
                f"{counts[first].sum()} landmarks: expected at least {_FEWEST_SHARED}{remedy}"
            )
        waiting.remove(k)
        known = known | lines[k]
        if counts[k][0] >= _FEWEST_SHARED:
            there, target = places[k, shared[k]], xy[shared[k]]
            motion = fitted(there, target)
            off = np.hypot(*(apply(motion, there) - target).T)
            apart = np.hypot(*(target - target.mean(axis=0)).T)
            if len(off) >= _FEWEST_COMPARED and np.median(off) > _MOST_OFF * np.median(apart):
                begins = next(p for p in recording.prefixes[lost[k - 1] :] if p != "start")
                raise SlamError(
                    f"{name}: the part from {begins} on has other landmarks with the same "
                    "identifiers: expected common ones, as `slam associate RUN_A RUN_B` gives them"
                )
            here = slice(lost[k - 1] + 1, lost[k] + 1 if k < len(lost) else None)
            poses[here, :2] = apply(motion, poses[here, :2])
            poses[here, 2] += motion[2]
            xy = np.where(np.isfinite(xy), xy, apply(motion, places[k]))
    return replace(begin, poses=poses, disc_xy=np.where(np.isfinite(xy), xy, begin.disc_xy))


def _with_lines(
    graph: Graph, recording: Recording, estimate: Estimate, placed: InitialLines
) -> tuple[Graph, Estimate, list[Minimum[Estimate]]]:
    """The problem with the lines whose positions stay determined when everything is fitted.

    Also its estimate, and the minima on the way there.
    """
    ids, xy, good = placed.ids, placed.xy, np.zeros(len(placed.ids), dtype=np.bool_)
    minima: list[Minimum[Estimate]] = []
    while True:
        graph, estimate = with_lines(graph, recording.lines, ids), replace(estimate, line_xy=xy)
        if np.all(good) or not len(ids):
            return graph, estimate, minima
        minima.append(_coarsely(graph, estimate, Weighting(loss="huber")))
        estimate = minima[-1].at
        good = well_placed(graph, estimate)
        ids, xy = ids[good], estimate.line_xy[good]


def _on_the_way(wanted: Weighting) -> list[Weighting]:
    """Stages towards a robust loss: least squares; then, if it is not convex, wider scales.

    Graduated non-convexity: starting from nearly least squares, outliers are released one by one
    (A. Blake, A. Zisserman, Visual Reconstruction, 1987).
    """
    if wanted.loss == "none":
        return []
    factors = _GRADUATION if wanted.loss == "geman-mcclure" else ()
    wider = [replace(wanted, loss_scale=factor * wanted.loss_scale) for factor in factors]
    return [Weighting(), *wider]


def _check_usable(
    recording: Recording, camera: Camera | None, weighting: Weighting, name: str
) -> None:
    if not len(recording.circles) and not len(recording.lines):
        raise SlamError(
            f"{name}: no landmark in it: expected rows of discs or, with --lines, of verticals, as "
            "`detect circles` and `detect lines` write them"
        )
    if not np.any(recording.circles.identified) and not np.any(recording.lines.identified):
        raise SlamError(
            f"{name}: no row has an identifier: expected a run with IDs; slam associate gives them "
            "to discs with three rows or more (--fewest-rows)"
        )
    if camera is None and (weighting.calibrate or len(recording.lines)):
        needs = "the camera's mounting" if weighting.calibrate else "lines"
        raise SlamError(f"{name}: {needs} cannot be estimated without a calibration: expected one")
    if weighting.calibrate and camera is not None:
        if len(recording.lines):
            raise SlamError(
                f"{name}: bearings do not determine the camera's mounting: expected discs alone"
            )
        check_rows_fit_camera(camera, recording.circles.xy)


def _left_out(recording: Recording, graph: Graph, placed: InitialLines) -> LeftOut:
    discs, lines = recording.circles.identified, recording.lines.identified
    unused = np.setdiff1d(np.append(placed.ids, placed.unplaced), graph.line_ids)
    return LeftOut(
        rows_without_id=int(np.sum(~discs) + np.sum(~lines)),
        discs_seen_once=int(np.sum(graph.disc_row_counts == 1)),
        lines_without_parallax=len(unused),
        line_rows=int(np.sum(lines)) - len(graph.line_pose),
        line_ids=tuple(unused.tolist()),
    )
