"""Prior data on each frame of a run: tilts, and landmarks with IDs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from detect.discs.identity import MappedDisc
from detect.errors import DetectError
from detect.sources.image_files import image_name
from redetect.landmarks import (
    CircleLandmark,
    Frame,
    FrameTilt,
    LineLandmark,
    Step,
    frames_of_rows,
    parse_rows,
    read_rows,
)
from redetect.landmarks.map_file import read_map, read_path
from redetect.storage.bounds import NOT_NEGATIVE, demand

T_co = TypeVar("T_co", covariant=True)

#: Discs of a map that are farther from a frame than this are not matched in it, metres.
_REACH_M = 20.0


class ByPrefix(Protocol[T_co]):
    """Data on each frame by its image's prefix: a dict, or a file that is read on demand."""

    def get(self, prefix: str, /) -> T_co | None: ...


class KnownOfFrame(NamedTuple):
    """Prior data on a frame: see `Known`."""

    tilt: FrameTilt | None = None
    lines: tuple[LineLandmark, ...] = ()
    discs: tuple[CircleLandmark, ...] = ()
    discs_level: bool = False
    mapped: tuple[MappedDisc, ...] = ()
    slack_m: float = 0.1


NOTHING = KnownOfFrame()


@dataclass(frozen=True)
class Known:
    """Prior data on the frames of a run, by the prefixes of their images."""

    tilts: ByPrefix[FrameTilt] | None = None  # of frames whose verticals are not detected
    lines: ByPrefix[Frame] | None = None  # with IDs, carried over to rows of the same lines
    discs: ByPrefix[Frame] | None = None  # the same of discs
    discs_level: bool = False  # whether these are corrected for the tilt
    #: Discs of a map: rows without an ID by `discs` get the ID of the one that they fall on.
    mapped: ByPrefix[Sequence[MappedDisc]] | None = None
    slack_m: float = 0.1  # standard deviation of where these are, besides their covariances

    def __post_init__(self) -> None:
        demand(self, DetectError, slack_m=NOT_NEGATIVE)

    def of(self, prefix: str) -> KnownOfFrame:
        """Prior data on a frame."""
        lines = self.lines.get(prefix) if self.lines else None
        discs = self.discs.get(prefix) if self.discs else None
        return KnownOfFrame(
            self.tilts.get(prefix) if self.tilts else None,
            lines.lines if lines else (),
            discs.circles if discs else (),
            self.discs_level,
            tuple(self.mapped.get(prefix) or ()) if self.mapped else (),
            self.slack_m,
        )


class FramesByImage:
    """The frames of a landmark file, by the name of their image; of equal names the last counts.

    The file is read once for the offset of each frame, and again there when a frame is requested:
    its rows are not kept in memory. If it is malformed there is a
    `redetect.landmarks.LandmarkFileError`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offsets: dict[str, int] = {}
        offset = 0
        for row in read_rows(path):
            if isinstance(row.record, Step):
                self._offsets[image_name(row.record.prefix)] = offset
            offset += len(row.source or b"")

    def get(self, prefix: str) -> Frame | None:
        """A frame; None if the file does not have it."""
        offset = self._offsets.get(image_name(prefix))
        if offset is None:
            return None
        with self._path.open("rb") as stream:
            stream.seek(offset)
            return next(frames_of_rows(parse_rows(stream, str(self._path))))


class MapByImage:
    """The discs of a map that the frames of a path should see, by the name of their image.

    Map and path are files of `slam map`; as them, malformed ones raise a `LandmarkFileError`.
    """

    def __init__(self, map_path: Path, path_path: Path) -> None:
        self._discs = read_map(map_path).discs
        path = read_path(path_path)
        self._poses = dict(zip(map(image_name, path.prefixes), path.poses))

    def get(self, prefix: str) -> Sequence[MappedDisc] | None:
        """The discs within reach of a frame's pose; None if the path does not have the frame."""
        pose = self._poses.get(image_name(prefix))
        if pose is None:
            return None
        cosine, sine = np.cos(pose[2]), np.sin(pose[2])
        robot_from_map = np.array([[cosine, sine], [-sine, cosine]])
        xy = (self._discs.xy - pose[:2]) @ robot_from_map.T
        near = np.flatnonzero(np.hypot(*xy.T) <= _REACH_M)
        spread = robot_from_map @ self._discs.covariance[near] @ robot_from_map.T
        numbers = np.column_stack([xy[near], spread[:, 0], spread[:, 1, 1]]).tolist()
        ids = self._discs.ids[near].tolist()
        return [MappedDisc(number, *values) for number, values in zip(ids, numbers)]
