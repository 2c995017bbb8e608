"""Detected markers against the truth: scores, and statistics by bins."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from cv2 import aruco

from camera import Camera
from detect.markers.detect import detect_markers
from detect.settings import MarkerSettings
from redetect.array_types import BoolArray, ByteArray, FloatArray, IntArray
from redetect.landmarks import squared_mahalanobis
from tools.evaluation import tables
from tools.simulator.markers.samples import SampleFrame
from tools.simulator.markers.truth import MarkerTruth

OURS = "redetect"

#: OpenCV's refinements of corners, by the names in the tables, and what is subtracted from their
#: corners: the AprilTag code puts (0, 0) at the upper left pixel's corner, not at its centre.
_REFINEMENTS = {
    "aruco": ("CORNER_REFINE_NONE", 0.0),
    "aruco subpix": ("CORNER_REFINE_SUBPIX", 0.0),
    "aruco contour": ("CORNER_REFINE_CONTOUR", 0.0),
    "aruco apriltag": ("CORNER_REFINE_APRILTAG", 0.0),
    "apriltag - 0.5": ("CORNER_REFINE_APRILTAG", 0.5),
}
PEERS = tuple(_REFINEMENTS)


class Found(NamedTuple):
    """Markers that a detector found in an image."""

    ids: IntArray  # (N,)
    corners: FloatArray
    """(N, 4, 2) Top left, top right, bottom right, bottom left as printed; pixels of the image as
    it is."""
    covariances: FloatArray | None = None
    """(N, 4, 2, 2) Of the corners, if the detector says."""


def known_to_opencv(dictionary: str) -> bool:
    """Whether OpenCV has a dictionary of that name."""
    return hasattr(aruco, f"DICT_{dictionary.upper()}")


def search(detector: str, image: ByteArray, camera: Camera | None, dictionary: str) -> Found:
    """What a detector, `OURS` or one of `PEERS`, finds in an image (H, W)."""
    if detector == OURS:
        own = detect_markers(image, MarkerSettings(dictionary=dictionary), camera)
        return Found(own.ids, own.corners, own.covariance)
    if detector not in PEERS:
        raise ValueError(
            f"{detector}: no such detector: expected {OURS} or one of {', '.join(PEERS)}"
        )
    corners, ids, _ = _aruco_detector(detector, dictionary).detectMarkers(image)
    if ids is None:
        return Found(np.zeros(0, np.int64), np.zeros((0, 4, 2)))
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2) - _REFINEMENTS[detector][1]
    return Found(np.asarray(ids, dtype=np.int64).ravel(), pixels)


@cache
def _aruco_detector(name: str, dictionary: str):  # type: ignore[no-untyped-def]
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = getattr(aruco, _REFINEMENTS[name][0])
    known = aruco.getPredefinedDictionary(getattr(aruco, f"DICT_{dictionary.upper()}"))
    return aruco.ArucoDetector(known, parameters)


MISSED, FOUND, MISIDENTIFIED = 0, 1, 2

# A detection belongs to a marker if its corners, in any order, are this near (in its widths).
_NEAR_WIDTHS = 0.25


class Outcome(NamedTuple):
    """Result of a detector for the markers of one frame."""

    status: IntArray
    """(M,) `MISSED`, `FOUND` or `MISIDENTIFIED` (wrong number, or turned) for each true marker."""
    errors_px: FloatArray  # (M, 4, 2) Found minus true corners; NaN unless found.
    normalised: FloatArray
    """(M, 4) Squared error over the detector's own covariance, per degree of freedom; NaN if it has
    none."""
    false: tuple[int, ...]  # Numbers of the detections where no marker is.
    repeated: int  # Further detections of markers found already.


def score_frame(markers: Sequence[MarkerTruth], found: Found) -> Outcome:
    """Compare detections with the truth."""
    count = len(markers)
    status = np.full(count, MISSED, dtype=np.int64)
    errors, normalised = np.full((count, 4, 2), np.nan), np.full((count, 4), np.nan)
    false: list[int] = []
    repeated = 0
    for k, (number, corners) in enumerate(zip(found.ids, found.corners)):
        which, turn = _nearest(markers, corners)
        if which < 0:
            false.append(int(number))
        elif status[which] != MISSED:
            repeated += 1
        elif number != markers[which].id or turn != 0:
            status[which] = MISIDENTIFIED
        else:
            status[which] = FOUND
            errors[which] = corners - markers[which].corners
            if found.covariances is not None:
                normalised[which] = squared_mahalanobis(errors[which], found.covariances[k]) / 2.0
    return Outcome(status, errors, normalised, tuple(false), repeated)


def _nearest(markers: Sequence[MarkerTruth], corners: FloatArray) -> tuple[int, int]:
    """The true marker at the corners, and the number of quarter turns between them."""
    best = (-1, 0)
    least = _NEAR_WIDTHS
    for which, marker in enumerate(markers):
        for turn in range(4):
            off = np.roll(corners, turn, axis=0) - marker.corners
            distance = float(np.linalg.norm(off, axis=1).mean()) / marker.width_px
            if distance < least:
                best, least = (which, turn), distance
    return best


COLUMNS = (
    "width_px", "slant_deg", "blur_px", "contrast_grey", "noise_grey", "motion_px", "clear",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class ScoredFrame:
    """The truth of a frame, without its image, and the results of the detectors."""

    seed: int
    index: int
    dictionary: str
    rows: FloatArray  # (M, 7) of `COLUMNS`.
    outcomes: dict[str, Outcome]


def scored_frame(frame: SampleFrame, found: dict[str, Found]) -> ScoredFrame:
    """The results of all detectors for a frame."""
    imaging = frame.imaging
    outcomes = {name: score_frame(frame.markers, of) for name, of in found.items()}
    rows = [
        (m.width_px, m.slant_deg, imaging.blur_px, m.contrast_grey, imaging.noise_grey,
         frame.motion_px, float(m.clear))
        for m in frame.markers
    ]  # fmt: skip
    table = np.array(rows).reshape(-1, len(COLUMNS))
    return ScoredFrame(frame.seed, frame.index, frame.dictionary, table, outcomes)


@dataclass(frozen=True, eq=False)
class ScoredMarkers:
    """All markers of many frames, and the result of each detector."""

    frames: int
    columns: dict[str, FloatArray]  # (M,) each of `COLUMNS`; clear is 0 or 1.
    outcomes: dict[str, Outcome]  # By detector, of all frames together.


def table_of(frames: Sequence[ScoredFrame]) -> ScoredMarkers:
    """All frames in one."""

    def joined(outcomes: list[Outcome]) -> Outcome:
        status, errors_px, normalised, false, repeated = zip(*outcomes, strict=True)
        return Outcome(
            np.concatenate(status), np.concatenate(errors_px), np.concatenate(normalised),
            sum(false, ()), sum(repeated),
        )  # fmt: skip

    rows = np.concatenate([frame.rows for frame in frames])
    outcomes = {n: joined([frame.outcomes[n] for frame in frames]) for n in frames[0].outcomes}
    return ScoredMarkers(len(frames), dict(zip(COLUMNS, rows.T)), outcomes)


#: Title of each quantity, and the limits of its bins.
BINS: dict[str, tuple[str, tuple[float, ...]]] = {
    "width_px": ("width / px", (12, 16, 20, 28, 40, 60, 90, 130, 200)),
    "slant_deg": ("slant / deg", (0, 15, 30, 45, 60, 70)),
    "blur_px": ("blur / px", (0.3, 0.5, 0.8, 1.3, 2.0, 3.0)),
    "contrast_grey": ("contrast / grey levels", (10, 20, 35, 60, 100, 200)),
}

# With fewer markers found in a bin, no errors are given.
_FEWEST = 5


def bins_of(table: ScoredMarkers) -> dict[str, BoolArray]:
    """(M,) which markers are clearly in view, and which of them are in each bin of a quantity."""
    clear = table.columns["clear"] > 0.0
    bins = {"all": clear}
    for quantity, (title, limits) in BINS.items():
        values = table.columns[quantity]
        for low, high in itertools.pairwise(limits):
            inside = (values >= low) & ((values < high) | (values == limits[-1]) & (values == high))
            bins[f"{title} {low:g}-{high:g}"] = clear & inside
    return bins


def _errors(outcome: Outcome, found: BoolArray) -> tuple[float, float, float, float]:
    """Median, root mean square and 95 % quantile of the distances of corners from the truth, and
    the mean squared error over the covariance per degree of freedom; NaN if too few were found.
    """
    if found.sum() < _FEWEST:
        return (np.nan,) * 4
    distances = np.linalg.norm(outcome.errors_px[found], axis=-1)
    normalised = outcome.normalised[found]
    known = np.isfinite(normalised)
    return (
        float(np.median(distances)),
        float(np.sqrt(np.mean(distances**2))),
        float(np.quantile(distances, 0.95)),
        float(np.mean(normalised[known])) if known.any() else np.nan,
    )


def counts_lines(table: ScoredMarkers) -> list[str]:
    """Numbers of misidentified, false and repeated detections of each detector."""
    markers = len(table.columns["clear"])
    clear = int(table.columns["clear"].sum())
    lines = [f"{table.frames} frames, {markers} markers, {clear} of them clearly in view"]
    lines += [
        f"{name:>15}: misidentified {np.count_nonzero(of.status == MISIDENTIFIED)}, "
        f"where there is no marker {len(of.false)}, twice {of.repeated}"
        for name, of in table.outcomes.items()
    ]
    return lines


def print_bins(table: ScoredMarkers, bins: dict[str, BoolArray]) -> dict[str, Any]:
    """Print detection rate and corner errors (pixels) by bins, and where a peer is ahead.

    Errors over the markers that each detector found itself; then our median and the peer's over
    those that both found. Returns the figures.
    """
    printed = tables.Table(
        {"": "<28", "detector": "<14", "markers": "d", "found": ".3f", "median": ".3f",
         "rms": ".3f", "95 %": ".3f", "error^2/dof": ".2f", "both: ours": ".3f", "peer": ".3f"},
        keys=2,
    )  # fmt: skip
    behind = []
    for label, inside in bins.items():
        markers, own = int(inside.sum()), table.outcomes[OURS]
        ours = inside & (own.status == FOUND)
        ahead = True
        for name, outcome in table.outcomes.items() if markers else ():
            found = inside & (outcome.status == FOUND)
            medians = np.nan, np.nan
            if name != OURS:
                medians = _errors(own, ours & found)[0], _errors(outcome, ours & found)[0]
            # With too few in common, the medians are unknown.
            ahead &= found.sum() <= ours.sum() and not medians[0] >= medians[1]
            printed.row(label, name, markers, found.sum() / markers, *_errors(outcome, found),
                        *medians)  # fmt: skip
        if not ahead:
            behind.append(label)
    print(f"BEHIND a peer in error or rate: {', '.join(behind) or 'nowhere'}")
    return printed.figures
