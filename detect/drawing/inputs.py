"""Rows of a run from files, image by image: detections and reference rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from detect.drawing.head import FileHead, read_head
from detect.errors import DetectError
from detect.run import ImageRun
from detect.runs.known import FramesByImage
from detect.seen import Tilt
from detect.sources.image_names import image_name
from detect.viewing_options import RowFiles
from landmarks import CircleLandmark, FrameTilt, LineLandmark, MarkerLandmark, read_tilts

KINDS = ("circles", "lines", "markers", "tilt")


@dataclass(frozen=True, slots=True)
class SeenRows:
    """The files' rows of one image; None where there is no file.

    Attributes
    ----------
    circles, lines, markers : tuple of rows or None
        Detected.
    tilt : FrameTilt or None
        None also where the frame has none.
    levelled_by : (float, float) or None
        Pitch and roll that turned the discs' positions level.
    reference_by : (float, float) or None
        The same of the reference rows.
    reference_circles, reference_lines : tuple of rows or None
        What they are compared with; None also if that file does not have the image.
    """

    circles: tuple[CircleLandmark, ...] | None = None
    lines: tuple[LineLandmark, ...] | None = None
    markers: tuple[MarkerLandmark, ...] | None = None
    tilt: FrameTilt | None = None
    levelled_by: Tilt | None = None
    reference_by: Tilt | None = None
    reference_circles: tuple[CircleLandmark, ...] | None = None
    reference_lines: tuple[LineLandmark, ...] | None = None


@dataclass(frozen=True)
class SeenFiles:
    """The files of a run's rows.

    Attributes
    ----------
    detected : dict
        Path of each kind of `KINDS` that there is.
    heads : dict
        Their heads, by kind.
    reference_circles, reference_lines : path or None
        The reference rows.
    """

    detected: dict[str, Path]
    heads: dict[str, FileHead]
    reference_circles: Path | None
    reference_lines: Path | None

    @cached_property
    def reference_level(self) -> bool:
        """Whether the reference rows of discs are level, whatever the tilt was."""
        return self.reference_circles is not None and read_head(self.reference_circles).level

    @property
    def radius_m(self) -> float:
        """Of the discs."""
        return self.heads.get("circles", FileHead()).circle_settings.radius_m


@dataclass(frozen=True)
class RowSource:
    """Rows of a run by image; of the files, only the offsets of frames are in memory."""

    files: SeenFiles
    _frames: dict[str, FramesByImage] = field(default_factory=dict)
    _tilts: Mapping[str, FrameTilt] | None = None

    def of(self, prefix: str) -> SeenRows:
        """The rows of an image, by the prefix of its STEP."""
        found = {kind: source.get(prefix) for kind, source in self._frames.items()}
        circles, lines, markers = (found.get(kind) for kind in KINDS[:3])
        wanted, wanted_lines = found.get("reference_circles"), found.get("reference_lines")
        levelled_by = None if circles is None else circles.levelled_by
        reference_by = None if wanted is None else wanted.levelled_by
        if reference_by is None and self.files.reference_level:
            reference_by = levelled_by
        return SeenRows(
            circles=None if circles is None else circles.circles,
            lines=None if lines is None else lines.lines,
            markers=None if markers is None else markers.markers,
            tilt=None if self._tilts is None else self._tilts.get(prefix),
            levelled_by=levelled_by,
            reference_by=reference_by,
            reference_circles=None if wanted is None else wanted.circles,
            reference_lines=None if wanted_lines is None else wanted_lines.lines,
        )


def find_files(run: ImageRun, options: RowFiles) -> SeenFiles:
    """Find the files of a run's rows, and read their heads.

    Parameters
    ----------
    run : ImageRun
        The run.
    options : RowFiles
        The options of a command line.

    Returns
    -------
    SeenFiles

    Raises
    ------
    DetectError
        If one that is named does not exist, or there is none at all.
    """
    detected: dict[str, Path] = {}
    for kind in KINDS:
        named: Path | None = getattr(options, kind)
        path = run.output(kind) if options.rows is None else options.rows / f"detected.{kind}"
        path = path if named is None else named
        if path.is_file():
            detected[kind] = path
        elif named is not None:
            raise DetectError(f"{path}: no such file: expected detected {kind}")
    if not detected:
        usual = run.output("circles") if options.rows is None else options.rows / "detected.circles"
        raise DetectError(
            f"{usual}: no such file, nor .lines, .markers or .tilt: expected one of them: run "
            "detect all (or circles, lines, markers) on the same images first, or name files"
        )
    return SeenFiles(
        detected,
        {kind: read_head(path) for kind, path in detected.items()},
        _reference(run.folder / "map.circles", options.reference, options.no_reference),
        _reference(run.folder / "map.lines", options.reference_lines, options.no_reference),
    )


def open_rows(files: SeenFiles) -> RowSource:
    """Find and index the files.

    Raises
    ------
    landmarks.LandmarkFileError
        If one cannot be read or a row is malformed; names file and line.
    """
    frames = {kind: path for kind, path in files.detected.items() if kind != "tilt"}
    if files.reference_circles is not None and "circles" in frames:
        frames["reference_circles"] = files.reference_circles
    if files.reference_lines is not None and "lines" in frames:
        frames["reference_lines"] = files.reference_lines
    tilt = files.detected.get("tilt")
    return RowSource(
        files,
        {kind: FramesByImage(path) for kind, path in frames.items()},
        None if tilt is None else read_tilts(tilt),
    )


def picture_name(prefix: str) -> str:
    """Name of an image's picture without its ending: nothing that leads out of a folder."""
    return image_name(prefix) or "frame"


def _reference(usual: Path, named: Path | None, unwanted: bool) -> Path | None:
    if unwanted:
        return None
    if named is not None:
        if not named.is_file():
            raise DetectError(f"{named}: no such file: expected reference rows")
        return named
    return usual if usual.is_file() else None
