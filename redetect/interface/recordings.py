"""Runs: the frames of a recording, and comparison of detected with reference rows."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from functools import cached_property
from itertools import islice
from operator import index
from pathlib import Path
from typing import Any, overload

from detect.comparison.compare import compare_run, compare_with_file
from detect.comparison.result import Comparison, Kind
from detect.errors import DetectError
from detect.options import CompareOptions, SourceOptions
from detect.projection import DiscProjection
from detect.sources.interface import Run, RunFrame
from detect.sources.opening import open_run
from redetect.interface.detection import CameraLike, Detection, RecordedFrame, camera_of
from redetect.landmarks.files import read_head
from redetect.messages import OneLineError, excerpt, keywords_named, path_of

PathLike = str | os.PathLike[str]


class LengthError(OneLineError, TypeError):
    """The number of frames is not known (a `TypeError`, so that `list` does without)."""


class Recording:
    """The frames of a run, in order; each iteration starts again.

    Attributes
    ----------
    name : str
    camera : Camera
    folder : path
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self.name, self.camera, self.folder = run.name, run.camera, run.folder

    def __iter__(self) -> Iterator[RecordedFrame]:
        with keywords_named():
            for frame in self._run.frames:
                yield RecordedFrame(frame, self.camera)

    @overload
    def __getitem__(self, number: int) -> RecordedFrame: ...

    @overload
    def __getitem__(self, number: slice) -> list[RecordedFrame]: ...

    def __getitem__(self, number: int | slice) -> RecordedFrame | list[RecordedFrame]:
        """A frame by its number, or those of a slice; those before a video's or bag's are read.

        Raises
        ------
        IndexError
            If there is no such frame.
        LengthError
            For slices and numbers from the end, if the number of frames is not known.
        """
        if isinstance(number, slice):
            return [self[k] for k in range(len(self))[number]]
        number = index(number)  # a TypeError if it is none
        at = number + len(self) if number < 0 else number
        with keywords_named():
            frames = self._run.frames if self._listed is None else self._listed
            for frame in islice(frames, at, None) if at >= 0 else ():
                return RecordedFrame(frame, self.camera)
        raise IndexError(f"{self.name} has no frame {number}")

    def __len__(self) -> int:
        """Number of frames; a `LengthError` for a video, bag or live camera."""
        if self._listed is None:
            raise LengthError(f"{self.name}: its length is known only once all frames are read")
        return len(self._listed)

    def __bool__(self) -> bool:
        return True  # also if the length is not known

    @cached_property
    def _listed(self) -> list[RunFrame] | None:
        """All frames, if their images are files: then they are small."""
        return None if self._run.frames.images_in_memory else list(self._run.frames)

    @property
    def expected(self) -> int | None:
        """Approximate number of frames, if known."""
        return self._run.frames.expected

    def __repr__(self) -> str:
        return f"<recording {self.name}: {self.expected or 'unknown number of'} frames>"


@keywords_named()
def open_recording(name: PathLike, camera: CameraLike | None = None, **source: Any) -> Recording:
    """Open a run folder, a folder or pattern of images, a video, a bag, or `camera:0`.

    Parameters
    ----------
    name : path
    camera : Camera, or path, optional
        The calibration; by default the `.cam` file beside the images, or that in the bag.
    **source
        Fields of `detect.options.SourceOptions`, such as `odometry`, `times` or `frames`.

    Returns
    -------
    Recording

    Raises
    ------
    detect.errors.DetectError
        If the source does not exist or cannot be read, or there is no calibration.
    camera.CameraError, redetect.landmarks.LandmarkFileError
        If the calibration or the odometry cannot be read.
    """
    for key in {"odometry", "times", "image_topic"} & source.keys():
        given = source[key]
        source[key] = str(path_of(given, f"a name as {key}", DetectError)) if given else ""
    options = SourceOptions(**source)
    place = path_of(name, "the name of a run, a folder, a video or a bag", DetectError)
    return Recording(open_run(place, None if camera is None else camera_of(camera), options))


@keywords_named()
def compare(
    run: PathLike,
    detected: PathLike | Detection | Iterable[Detection] | None = None,
    reference: PathLike | None = None,
    *,
    lines: bool = False,
    camera: CameraLike | None = None,
    options: CompareOptions | None = None,
) -> Comparison:
    """Compare detected discs, or verticals, with reference rows, as `detect compare` does.

    Parameters
    ----------
    run : path
        Run folder.
    detected : path, Detection, or iterable of Detection, optional
        Detected rows; by default `detected.circles` (`detected.lines`) in the run folder.
    reference : path, optional
        Reference rows; by default `map.circles` (`map.lines`) in the run folder.
    lines : bool
        Compare verticals instead of discs.
    camera : Camera, or path, optional
        Calibration; by default the one in the run folder, or that of the detections.
    options : CompareOptions, optional
        How rows are matched, and which rows count.

    Returns
    -------
    DiscComparison or LineComparison
        Its `sentences()` summarise the result in words.

    Raises
    ------
    detect.errors.DetectError
        If there are no such rows.
    redetect.landmarks.LandmarkFileError
        If a file is malformed.
    detect.errors.CompareError
        If an image has two frames, or no image is in both.
    """
    run = path_of(run, "a run folder", DetectError)
    kind: Kind = "lines" if lines else "circles"
    seen_by = None if camera is None else camera_of(camera)
    if not isinstance(options, CompareOptions | None):
        raise DetectError(f"options is {excerpt(options)}: expected rd.CompareOptions")
    in_file = None
    if reference is not None:
        in_file = path_of(reference, "the name of a file of rows", DetectError)
    if detected is None or isinstance(detected, str | os.PathLike):
        path = None if detected is None else Path(detected)
        return compare_run(run, kind, path, in_file, camera=seen_by, options=options)
    found = list(detected) if isinstance(detected, Iterable) else [detected]
    for one in found:
        if not isinstance(one, Detection):
            raise DetectError(f"{excerpt(one)}: expected a Detection, or the name of a file")
    in_file = in_file or run / f"map.{kind}"
    if not found or not in_file.is_file():
        raise DetectError(
            f"{run}: nothing to compare: expected detections, and reference rows in {in_file}"
        )
    seen_by = seen_by or found[0].camera
    projection = DiscProjection(seen_by, found[0].settings, read_head(in_file).level)
    frames, names = [one.frame for one in found], (str(in_file), "detections")
    return compare_with_file(kind, in_file, frames, options, projection=projection, names=names)
