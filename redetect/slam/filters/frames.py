"""A recording frame by frame, as input of filters, and the result of a filter."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks.map_file import Path2D
from redetect.slam.filters.innovation_kernels import MeasuredDiscs, MeasuredLines, frame_innovation
from redetect.slam.recording import Recording

NO_CAMERA = np.zeros(2)


@dataclass(frozen=True, eq=False)
class FrameRows:
    """Measurements of one frame."""

    disc_ids: tuple[int, ...]  # -1 where unknown
    disc_xy: FloatArray  # (d, 2): in the robot frame (m)
    disc_covariance: FloatArray  # (d, 2, 2)
    line_ids: tuple[tuple[int, ...], ...]  # all lines that a row shows; empty where unknown
    bearing_rad: FloatArray  # (l,)
    sigma_rad: FloatArray  # (l,)

    def identified(
        self, disc_ids: tuple[int, ...], line_ids: tuple[tuple[int, ...], ...]
    ) -> FrameRows:
        """The same rows under other identifiers."""
        return FrameRows(
            disc_ids, self.disc_xy, self.disc_covariance, line_ids, self.bearing_rad, self.sigma_rad
        )

    def innovation(
        self,
        discs: Sequence[int],
        lines: Sequence[int],
        disc_slots: Mapping[int, int],
        line_slots: Mapping[int, int],
        state: FloatArray,
        linearised_at: FloatArray,
        camera_xy: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
        """Innovation of some of the rows.

        Takes `state, linearised_at` (n,), `camera_xy` (2,).
        """
        line_ids = [self.line_ids[k] for k in lines]
        return frame_innovation(
            state,
            linearised_at,
            MeasuredDiscs(
                np.array([disc_slots[self.disc_ids[k]] for k in discs], dtype=np.int64),
                self.disc_xy[discs],
                self.disc_covariance[discs],
            ),
            MeasuredLines(
                np.array([line_slots[i] for ids in line_ids for i in ids], dtype=np.int64),
                np.cumsum([0, *map(len, line_ids)]),
                self.bearing_rad[lines],
                self.sigma_rad[lines],
            ),
            camera_xy,
        )


@dataclass
class RowCount:
    """How a run's rows were used."""

    # Rows that were used.
    discs: int = 0
    lines: int = 0
    left_out: Counter[str] = field(default_factory=Counter)  # rows that were not, by the reason
    # Sum of the squared innovations, normalised by their covariances.
    innovation_squared: float = 0.0
    # Their degrees of freedom: if the covariances are right, what the sum is expected to be.
    innovation_numbers: int = 0


@dataclass(frozen=True, eq=False)
class FilterRun:
    """Poses of a run as a filter had them at the time, and what became of the rows.

    Attributes
    ----------
    path : Path2D
        The start, and the pose after each step and its frame, with covariances; theta is not
        wrapped.
    count : RowCount
    disc_ids : (n,) int64
        The disc that each row was taken to show, -1 where none: the file's, or what association
        found.
    line_ids : tuple of tuples of int
        The same of lines; empty where none.
    """

    path: Path2D
    count: RowCount
    disc_ids: IntArray
    line_ids: tuple[tuple[int, ...], ...]


def frames_of(recording: Recording) -> Iterator[FrameRows]:
    """The rows of each frame of a run, in order."""
    circles, lines = recording.circles, recording.lines
    frames = np.arange(len(recording) + 1)
    disc_start = np.searchsorted(circles.frame, frames)
    line_start = np.searchsorted(lines.frame, frames)
    disc_ids = circles.ids.tolist()
    for k in range(len(recording)):
        discs = slice(disc_start[k], disc_start[k + 1])
        some = slice(line_start[k], line_start[k + 1])
        yield FrameRows(
            disc_ids=tuple(disc_ids[discs]),
            disc_xy=circles.xy[discs],
            disc_covariance=circles.covariance[discs],
            line_ids=lines.ids[some],
            bearing_rad=lines.bearing_rad[some],
            sigma_rad=lines.sigma_rad[some],
        )


class Filter(Protocol):
    """A filter that is taken through a run."""

    disc_slots: dict[int, int]
    line_slots: dict[int, int]
    camera_xy: FloatArray
    count: RowCount

    @property
    def state(self) -> FloatArray:
        """The pose, then landmarks, as the slots say."""

    @property
    def pose_covariance(self) -> FloatArray:
        """(3, 3)."""

    def block(self, index: IntArray) -> FloatArray:
        """Rows and columns of the state's covariance."""

    def predict(self, step: FloatArray, noise: FloatArray) -> None:
        """The robot moves by an odometry step (3,), of covariance (3, 3)."""

    def measure(self, rows: FrameRows) -> None:
        """Update with the rows of a frame."""
