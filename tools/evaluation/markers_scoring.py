"""Detected markers held against the truth of a rendered frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tools.evaluation.markers_detectors import Found
from tools.simulator.markers.sampling import SampleFrame
from tools.simulator.markers.truth import MarkerTruth

MISSED, FOUND, MISIDENTIFIED = 0, 1, 2

# A detection is of a marker if its corners, in any order, are as near as this in its widths.
_NEAR_WIDTHS = 0.25


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a detector made of the markers of one frame.

    Attributes
    ----------
    status : (M,) int64
        `MISSED`, `FOUND` or `MISIDENTIFIED` (wrong number, or turned) for each true marker.
    errors_px : (M, 4, 2) float64
        Found minus true corners; NaN unless found.
    normalised : (M, 4) float64
        Squared error over the detector's own covariance, per degree of freedom; NaN if it has none.
    false : tuple of int
        Numbers of the detections where no marker is.
    repeated : int
        Further detections of markers found already.
    """

    status: NDArray[np.int64]
    errors_px: NDArray[np.float64]
    normalised: NDArray[np.float64]
    false: tuple[int, ...]
    repeated: int


def score_frame(markers: Sequence[MarkerTruth], found: Found) -> Outcome:
    """Hold what was found against the truth.

    Parameters
    ----------
    markers : sequence of MarkerTruth
        Of the frame; hidden ones too.
    found : Found
        By the detector.

    Returns
    -------
    Outcome
    """
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
                solved = np.linalg.solve(found.covariances[k], errors[which][..., None])
                normalised[which] = np.sum(errors[which] * solved[..., 0], axis=1) / 2.0
    return Outcome(status, errors, normalised, tuple(false), repeated)


def _nearest(markers: Sequence[MarkerTruth], corners: NDArray[np.float64]) -> tuple[int, int]:
    """The true marker that lies where the corners are, and by how many quarters it is turned."""
    best = (-1, 0)
    least = _NEAR_WIDTHS
    for which, marker in enumerate(markers):
        for turn in range(4):
            off = np.roll(corners, turn, axis=0) - marker.corners
            distance = float(np.linalg.norm(off, axis=1).mean()) / marker.width_px
            if distance < least:
                best, least = (which, turn), distance
    return best


@dataclass(frozen=True, eq=False)
class Table:
    """All markers of many frames, and what each detector made of them.

    Attributes
    ----------
    frames : int
        Frames looked at.
    columns : dict of str to (M,) float64
        width_px, slant_deg, blur_px, contrast_grey, noise_grey, motion_px, clear (0 or 1).
    status : dict of detector to (M,) int64
    errors_px : dict of detector to (M, 4, 2) float64
    normalised : dict of detector to (M, 4) float64
    false : dict of detector to int
        Detections where no marker is.
    repeated : dict of detector to int
    """

    frames: int
    columns: dict[str, NDArray[np.float64]]
    status: dict[str, NDArray[np.int64]]
    errors_px: dict[str, NDArray[np.float64]]
    normalised: dict[str, NDArray[np.float64]]
    false: dict[str, int]
    repeated: dict[str, int]


@dataclass(frozen=True, eq=False)
class ScoredFrame:
    """A frame's truth, without its image, and what became of it."""

    seed: int
    index: int
    dictionary: str
    rows: NDArray[np.float64]
    """(M, 7) of `COLUMNS`."""
    things: tuple[str, ...]
    outcomes: dict[str, Outcome]


COLUMNS = (
    "width_px", "slant_deg", "blur_px", "contrast_grey", "noise_grey", "motion_px", "clear",
)  # fmt: skip


def scored_frame(frame: SampleFrame, outcomes: dict[str, Outcome]) -> ScoredFrame:
    """What is kept of a frame."""
    rows = [
        (
            marker.width_px,
            marker.slant_deg,
            frame.imaging.blur_px,
            marker.contrast_grey,
            frame.imaging.noise_grey,
            frame.motion_px,
            float(marker.clear),
        )
        for marker in frame.markers
    ]
    return ScoredFrame(
        frame.seed, frame.index, frame.dictionary, np.array(rows).reshape(-1, len(COLUMNS)),
        frame.things, outcomes,
    )  # fmt: skip


def table_of(frames: Sequence[ScoredFrame]) -> Table:
    """All frames in one.

    Parameters
    ----------
    frames : sequence of ScoredFrame
        At least one.
    """
    names = list(frames[0].outcomes)
    rows = np.concatenate([frame.rows for frame in frames])

    def joined(attribute: str, name: str) -> NDArray[np.float64]:
        return np.concatenate([getattr(frame.outcomes[name], attribute) for frame in frames])

    return Table(
        frames=len(frames),
        columns={name: rows[:, k] for k, name in enumerate(COLUMNS)},
        status={name: joined("status", name).astype(np.int64) for name in names},
        errors_px={name: joined("errors_px", name) for name in names},
        normalised={name: joined("normalised", name) for name in names},
        false={n: sum(len(f.outcomes[n].false) for f in frames) for n in names},
        repeated={n: sum(f.outcomes[n].repeated for f in frames) for n in names},
    )
