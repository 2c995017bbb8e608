"""Associates the rows of a run: from frame to frame, then by closing loops.

First, every row is associated with recently seen landmarks
(`redetect.slam.association.frame_to_frame`). The result is nearly always right, but a landmark that
is seen again later has several labels. Then loops are detected (`redetect.slam.association.loops`)
and closed (`redetect.slam.association.loop_closing`) in rounds. The first round searches within the
possible drift of the odometry, later rounds everywhere, since each closed loop reduces the map's
distortion. Verticals, which the local association often confuses, are then associated again along
the path that the discs give (`redetect.slam.association.line_points`).

Several runs are treated as one with lost steps in between (`redetect.slam.recording.joined`). Loops
are closed in each, their maps are registered (`redetect.slam.association.registration`), and loops
are closed again in the whole.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.landmarks import squared_mahalanobis, wrap_angle
from redetect.plane import chain_steps, compose, rotation
from redetect.slam.association import loops
from redetect.slam.association.frame_to_frame import LocalLabels, associate_locally
from redetect.slam.association.line_points import lines_by_points
from redetect.slam.association.loop_closing import (
    SAME_PLACE,
    closed_path,
    consistent_matches,
    in_order,
    intersect_bearings,
    merge_labels,
    pairs_by_position,
    pairs_by_votes,
    solve_path,
)
from redetect.slam.association.registration import ANYWHERE, register_maps
from redetect.slam.errors import UnregisteredError
from redetect.slam.models import bearing_of_vertical, disc_in_robot, tilt_jacobian
from redetect.slam.recording import LineRows, Recording
from redetect.slam.settings import AssociateSettings

Progress = Callable[[str], None]

# Edges of one door frame may be 0.1 m apart.
_LINE_REACH_M = 0.05
# Covariance of a step that leads nowhere (m^2, rad^2).
_NEGLIGIBLE_COVARIANCE = 1e-6 * np.eye(3)
# Discs with rows in the same frames are distinct, unless these are at most this share of the frames
# of either. Lines always are, since they are often confused from frame to frame.
_MOST_TOGETHER = 0.1
# Largest increase of the cost of all rows by a loop, for each disc that it merges. A right loop
# costs a few, up to 20 with odometry that is wrong by 20 %; a wrong one hundreds.
_MOST_COST = 100.0
# Matches that may contain a wrong one are divided into at most this many parts.
_MOST_PARTS = 16
# Submaps are longer, at most of this many frames, if they have fewer discs that are seen often
# (median) than are enough to recognise a place.
_LONGEST, _FEWEST_DISCS_OF_A_PLACE, _SEEN_OFTEN = 200, 12.0, 3
# Most rounds of closing loops.
_MOST_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class RunAssociation:
    """Labels of a run's rows, numbered from 0 in the order of first sight."""

    circle_labels: IntArray  # (n,): final; -1 for rows that fit no disc that is seen often
    line_labels: IntArray
    local_circle_labels: IntArray  # (n,): from frame to frame only
    local_line_labels: IntArray
    matches: tuple[loops.Match, ...]  # the loops that were closed
    path: FloatArray | None  # (N + 1, 3): the corresponding path; None without map level
    slips: FloatArray  # (N,): see `LocalLabels`


def associate_run(
    recording: Recording,
    settings: AssociateSettings | None = None,
    *,
    camera_xy: ArrayLike = (0.0, 0.0),
    progress: Progress | None = None,
) -> RunAssociation:
    """Find which rows show the same landmark, ignoring IDs in the file.

    Only bearings of lines need the camera's centre in the robot frame, `camera_xy` (2,) (m).
    `progress` is called with a description of the current stage. Raises `UnregisteredError` if the
    run consists of parts, one of which has no certain place among the others.
    """
    settings = settings or AssociateSettings()
    report = progress or (lambda _: None)
    local = _associated_locally(recording, settings, camera_xy, report)
    slipped = local.slips[:, None, None] * recording.step_covariance
    recording = replace(recording, step_covariance=slipped)
    swayed = _with_sway(recording, settings)
    circle_labels, line_labels, _ = local
    matches: tuple[loops.Match, ...] = ()
    path = None
    if settings.map_level and len(recording.circles):
        run = _Run(_without_lines(swayed), settings, camera_xy, report)
        closed = _closed_by_parts(run, circle_labels)
        labels, path, matches = closed.at.labels, closed.at.path, closed.matches
        circle_labels = without_clutter(recording, labels, path, settings)
        if len(line_labels):
            report("verticals on the path of the discs")
            scale = settings.sigma_scale
            line_labels, path_of_both = lines_by_points(
                recording, path, labels, line_labels, camera_xy=camera_xy, disc_sigma_scale=scale
            )
            line_labels = _merged_lines(recording, path_of_both, line_labels, settings, camera_xy)
    elif settings.map_level:
        run = _Run(swayed, settings, camera_xy, report)
        closed = _closed_by_parts(run, line_labels)
        line_labels, path, matches = closed.at.labels, closed.at.path, closed.matches
    circle_labels, line_labels = in_order(circle_labels), in_order(line_labels)
    local_circles, local_lines = in_order(local.circles), in_order(local.lines)
    return RunAssociation(
        circle_labels, line_labels, local_circles, local_lines, matches, path, local.slips
    )


def _associated_locally(
    recording: Recording, settings: AssociateSettings, camera_xy: ArrayLike, report: Progress
) -> LocalLabels:
    """Labels from frame to frame; of a run with discs and lines, discs are associated alone."""
    both = len(recording.circles) > 0 and len(recording.lines) > 0
    local = associate_locally(
        recording,
        # Bearings say more of a frame's heading than discs, whose sway would only blur it.
        replace(settings, tilt_sigma_deg=0.0) if both else settings,
        camera_xy=camera_xy,
        progress=lambda done: report(f"frame {done} of {len(recording)}"),
    )
    if both:
        # Discs help to associate lines; lines are often confused and would only harm the discs.
        local = associate_locally(_without_lines(recording), settings)._replace(lines=local.lines)
    return local


class _Solved(NamedTuple):
    """Least squares of a run with some labels."""

    labels: IntArray  # (n,): see `_Run`
    path: FloatArray  # (N + 1, 3)
    xy: FloatArray  # (M, 2): the landmarks' positions (m)
    cost: float


class _Closed(NamedTuple):
    """A run whose loops are closed."""

    at: _Solved
    matches: tuple[loops.Match, ...]  # the loops
    submap_frames: int  # length of the submaps that were matched


class _Run(NamedTuple):
    """A run to be associated by its discs, whose rows give positions, or else by its lines."""

    recording: Recording  # with the robot's sway
    settings: AssociateSettings
    camera_xy: ArrayLike
    report: Progress

    @property
    def by_discs(self) -> bool:
        return len(self.recording.circles) > 0

    @property
    def frames(self) -> IntArray:
        """(n,) frames of the labels' rows."""
        return self.recording.circles.frame if self.by_discs else self.recording.lines.frame

    def merged(self, labels: IntArray, pairs: Sequence[tuple[int, int]]) -> tuple[IntArray, int]:
        return merge_labels(self.frames, labels, pairs, _MOST_TOGETHER if self.by_discs else 0.0)

    def submaps(self, at: _Solved, length: int, **limits: Any) -> list[loops.Submap]:
        """Submaps of the run; `limits` as in `redetect.slam.association.loops.submaps_of`."""
        count = len(self.recording)
        return loops.submaps_of(self.frames, at.labels, at.xy, count, length=length, **limits)

    def solved(self, labels: IntArray, path: FloatArray | None) -> _Solved:
        recording, none, camera_xy = self.recording, np.zeros(0, dtype=np.int64), self.camera_xy
        start = chain_steps(recording.steps) if path is None else path
        if self.by_discs:
            scale = self.settings.sigma_scale
            found = solve_path(recording, labels, none, start, sigma_scale=scale)
            return _Solved(labels, found.path, found.circle_xy, found.cost)
        line_xy = intersect_bearings(recording, start, labels, camera_xy=camera_xy)
        found = solve_path(recording, none, labels, start, line_xy, camera_xy=camera_xy)
        return _Solved(labels, found.path, found.line_xy, found.cost)


def _closed_by_parts(run: _Run, labels: IntArray) -> _Closed:
    """Close loops in each part between lost steps of odometry, register the parts' maps in the
    first one, and close loops in the whole.
    """
    recording, frames = run.recording, run.frames
    starts = sorted({0, *recording.lost.tolist()})
    parts: list[_Closed] = []
    submaps: list[list[loops.Submap]] = []
    places: list[FloatArray] = []
    for first, end in zip(starts, [*starts[1:], len(recording)]):
        part = recording.part(first, end)
        if parts:  # a part begins with its own start, not with the end of the one before
            known = np.concatenate([_NEGLIGIBLE_COVARIANCE[None], part.step_covariance[1:]])
            part = replace(part, step_covariance=known)
        rows = slice(*np.searchsorted(frames, [first, end]))
        own = run._replace(recording=part)
        closed = _closed(own, in_order(labels[rows]))
        parts.append(closed)
        compared = own.submaps(
            closed.at,
            closed.submap_frames,
            overlapping=False,
            least=ANYWHERE.least_agreeing,
            most=loops.MOST_COMPARED,
        )
        submaps.append(compared)
        places.append(np.full_like(closed.at.xy, np.nan))
        for submap in compared:  # others may be clutter
            places[-1][submap.labels] = submap.xy
    if len(parts) == 1:
        return parts[0]
    run.report("registering the parts")
    motions, pairs, left = register_maps(places, submaps)
    if left:
        frame = starts[left[0]]
        raise UnregisteredError(
            f"the frames from {recording.prefixes[frame]} on cannot be registered with the others: "
            "expected common landmarks",
            frame,
        )
    counts = np.cumsum([0, *(len(part.at.xy) for part in parts)])
    together = np.concatenate([part.at.labels + count for part, count in zip(parts, counts)])
    paths = [compose(motions[k], part.at.path[int(k > 0) :]) for k, part in enumerate(parts)]
    labels, _ = run.merged(together, pairs_by_votes(pairs))
    whole = _closed(run, labels, np.concatenate(paths))
    matches = [match for closed in (*parts, whole) for match in closed.matches]
    return whole._replace(matches=tuple(matches))


def _closed(run: _Run, labels: IntArray, path: FloatArray | None = None) -> _Closed:
    """Close all loops, starting from a path (by default odometry)."""
    # With a path, most of the map is in its place already.
    search = loops.Search(mostly_closed=path is not None)
    at = run.solved(labels, path)
    matches: list[loops.Match] = []
    while True:
        length = search.submap_frames
        for number in range(1, _MOST_ROUNDS + 1):
            run.report(f"loops, submaps of {length} frames, round {number}")
            before = len(at.xy)
            found = loops.find_matches(run.submaps(at, length, most=loops.MOST_COMPARED), search)
            found = consistent_matches(found, matches, at.path, run.recording.step_covariance)
            at, found = _with_matches(run, at, found)
            spread = _isotropic(len(at.xy), loops.REACH_M)
            if run.by_discs:
                spread = _spread(run.recording, at.path, at.labels, run.settings.sigma_scale)
            pairs = pairs_by_position(run.submaps(at, length), spread)
            labels, by_position = run.merged(at.labels, pairs)
            if by_position:
                at = run.solved(labels, at.path)
            matches += found
            if len(at.xy) == before and search.most_shift_m == math.inf:
                break
            search = loops.Search(math.inf, math.inf, submap_frames=length, mostly_closed=True)
        if not run.by_discs or length == _LONGEST or not _sparse(run, at, length):
            return _Closed(at, tuple(matches), length)
        search = loops.Search(submap_frames=min(2 * length, _LONGEST))


def _sparse(run: _Run, at: _Solved, length: int) -> bool:
    """Whether submaps of a length have too few discs to be recognised."""
    often = np.bincount(at.labels)[at.labels] >= _SEEN_OFTEN
    frames, labels, count = run.frames[often], at.labels[often], len(run.recording)
    submaps = loops.submaps_of(
        frames, labels, at.xy, count, length=length, overlapping=False, least=0
    )
    return float(np.median([len(submap.labels) for submap in submaps])) < _FEWEST_DISCS_OF_A_PLACE


def _with_matches(
    run: _Run, before: _Solved, matches: Sequence[loops.Match]
) -> tuple[_Solved, list[loops.Match]]:
    """The run with matches closed, except those that its rows contradict, and the closed ones.

    In a regular pattern of discs, odometry cannot exclude every wrong match. These bend the path,
    so that errors of all rows along it increase the cost far more than those of a right match.
    """
    if not matches:
        # Lines intersect elsewhere along the solved path.
        return (before if run.by_discs else run.solved(before.labels, before.path)), []
    at, closed = before, list[loops.Match]()
    waiting = [sorted(matches, key=lambda match: (match.later_frame, match.earlier_frame))]
    fewest = math.ceil(len(matches) / _MOST_PARTS)
    while waiting:
        some = waiting.pop()
        together = [*closed, *some]
        labels, _ = run.merged(before.labels, pairs_by_votes(match.pairs for match in together))
        trial = run.solved(labels, closed_path(before.path, together, run.recording.lost))
        if not run.by_discs or trial.cost - at.cost <= _MOST_COST * (len(at.xy) - len(trial.xy)):
            at, closed = trial, together
        elif len(some) > fewest:
            half = len(some) // 2
            waiting += [some[half:], some[:half]]
    return at, closed


def _without_lines(recording: Recording) -> Recording:
    return replace(recording, lines=LineRows.of())


def _with_sway(recording: Recording, settings: AssociateSettings) -> Recording:
    """The run with the robot's sway added to its discs' covariances."""
    if settings.tilt_sigma_rad == 0.0:
        return recording
    moving = settings.tilt_sigma_rad * tilt_jacobian(recording.circles.xy)
    covariance = recording.circles.covariance + moving @ moving.swapaxes(1, 2)
    return replace(recording, circles=replace(recording.circles, covariance=covariance))


def without_clutter(
    recording: Recording, labels: IntArray, path: FloatArray, settings: AssociateSettings
) -> IntArray:
    """Labels of discs, -1 for outliers, and for rows of discs with too few rows.

    Clutter kept some labels of one disc apart: without it, they are merged. Takes `labels` (n,),
    numbered from 0 without gaps, and their `path` (N + 1, 3); returns (n,).
    """
    gate = chdtri(2, 1.0 - settings.kept_probability)
    circles, frames = recording.circles, recording.circles.frame
    swayed = _with_sway(recording, settings)
    kept = np.ones(len(labels), dtype=np.bool_)
    none = np.zeros(0, dtype=np.int64)
    # The second pass excludes the rows found by the first.
    for last in (False, True):
        known, numbers = np.unique(labels[kept], return_inverse=True)
        fitting = _without_lines(replace(recording, circles=circles.only(kept)))
        solution = solve_path(fitting, numbers, none, path)
        path = solution.path
        places = np.full((int(labels.max(initial=-1)) + 1, 2), np.nan)
        places[known] = solution.circle_xy
        off = disc_in_robot(path[frames + 1], places[labels]) - circles.xy
        squared = squared_mahalanobis(off, circles.covariance)
        kept = (squared <= gate) & _nearest_of_frame(frames, labels, squared)
        kept &= np.bincount(labels[kept], minlength=len(places))[labels] >= settings.fewest_rows
        if not last and np.any(kept):
            known, numbers = np.unique(labels[kept], return_inverse=True)
            rows = replace(swayed, circles=swayed.circles.only(kept))
            submaps = loops.submaps_of(frames[kept], numbers, places[known], len(recording))
            spread = _spread(rows, path, numbers, settings.sigma_scale)
            pairs = pairs_by_position(submaps, spread)
            merged, _ = merge_labels(frames[kept], numbers, pairs)
            of_merged = known[numbers[np.unique(merged, return_index=True)[1]]]
            renamed = np.arange(len(places))
            renamed[known[numbers]] = of_merged[merged]
            labels = renamed[labels]
    return np.where(kept, labels, -1)


def _nearest_of_frame(frames: IntArray, labels: IntArray, squared: FloatArray) -> BoolArray:
    """(n,) mask of the rows with the least squared error of those with one label in a frame."""
    order = np.lexsort((squared, labels, frames))
    _, first = np.unique(np.stack([frames, labels])[:, order], axis=1, return_index=True)
    nearest = np.zeros(len(order), dtype=np.bool_)
    nearest[order[first]] = True
    return nearest


def _spread(
    recording: Recording, path: FloatArray, labels: IntArray, sigma_scale: float
) -> FloatArray:
    """(M, 2, 2) covariances of the positions of labels of one disc in the map.

    They use the mean information of a label's rows, whose errors are common (calibration, lean, one
    side of the disc), so that many rows are hardly better than one.
    """
    circles = recording.circles
    turn = rotation(path[circles.frame + 1, 2])
    information = np.linalg.inv(sigma_scale**2 * turn @ circles.covariance @ turn.swapaxes(1, 2))
    count = np.bincount(labels)
    total = np.zeros((len(count), 2, 2))
    np.add.at(total, labels, information)
    return np.asarray(count[:, None, None] * np.linalg.inv(total))


def _isotropic(count: int, reach_m: float) -> FloatArray:
    """(count, 2, 2) covariances with which positions are compatible up to a distance."""
    return np.tile(0.5 * reach_m**2 / chdtri(2, 1.0 - SAME_PLACE) * np.eye(2), (count, 1, 1))


def _merged_lines(
    recording: Recording,
    path: FloatArray,
    labels: IntArray,
    settings: AssociateSettings,
    camera_xy: ArrayLike,
) -> IntArray:
    """Labels of lines, those at the same position in the map merged, -1 for clutter."""
    for _ in range(_MOST_ROUNDS):
        xy = intersect_bearings(recording, path, labels, camera_xy=camera_xy)
        submaps = loops.submaps_of(recording.lines.frame, labels, xy, len(recording))
        pairs = pairs_by_position(submaps, _isotropic(len(xy), _LINE_REACH_M))
        labels, merged = merge_labels(recording.lines.frame, labels, pairs)
        if merged == 0:
            break
    lines = recording.lines
    xy = intersect_bearings(recording, path, labels, camera_xy=camera_xy)[labels]
    off = bearing_of_vertical(path[lines.frame + 1], xy, camera_xy) - lines.bearing_rad
    # Rows of lines without a position cannot contradict it.
    gate = lines.sigma_rad * np.sqrt(chdtri(1, 1.0 - settings.kept_probability))
    kept = ~(np.abs(wrap_angle(off)) > gate)
    kept &= np.bincount(labels[kept], minlength=len(labels))[labels] >= settings.fewest_rows
    return np.where(kept, labels, -1)
