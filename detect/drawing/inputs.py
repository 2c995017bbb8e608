"""What is drawn and compared: rows of a run from files, their heads, and which frames.

Detections and reference rows are read image by image; the head of a file says how its rows were
made.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.run import Frames, ImageRun, RunFrame
from detect.runs.known import FramesByImage
from detect.runs.outputs import LEVEL, LEVELLED
from detect.seen import Tilt
from detect.settings import CircleSettings
from detect.sources.image_names import image_name
from detect.tune.grid import parameter_value
from detect.viewing_options import RowFiles
from landmarks import CircleLandmark, FrameTilt, LineLandmark, MarkerLandmark, read_tilts
from storage.messages import excerpt

KINDS = ("circles", "lines", "markers", "tilt")
# The head is what precedes the first row; real ones are much shorter.
_LONGEST_BYTES = 1 << 16
#: Settings that are several numbers.
_PAIRS, _LIST = "refine_steps_px", "blurred_widths"
_NUMBERS = re.compile(r"[^(),]+")
_RANGE = re.compile(r"(\d*):(\d*)(?::(\d+))?")


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


@dataclass(frozen=True)
class FileHead:
    """The head of a file of rows, as far as it is understood.

    Attributes
    ----------
    comments : tuple of str
        Its lines without the signs of comment.
    settings : tuple of (str, str)
        The effective settings: names and values, as they are written.
    level : bool
        Whether it says that positions of discs are corrected for the frames' tilts, or true ones
        in the level robot frame.
    name : str
        What messages call the file.
    """

    comments: tuple[str, ...] = ()
    settings: tuple[tuple[str, str], ...] = ()
    level: bool = False
    name: str = ""

    @property
    def circle_settings(self) -> CircleSettings:
        """The settings of discs, the defaults where the head does not give them.

        Raises
        ------
        DetectError
            If one has a value that none can have.
        """
        try:
            return CircleSettings(**_values(CircleSettings, self.settings))
        except DetectError as error:
            raise DetectError(f"{self.name}: {error}") from None

    @property
    def line_settings(self) -> LineSettings:
        """The settings of verticals; as `circle_settings`."""
        try:
            return LineSettings(**_line_values(self.settings))
        except DetectError as error:
            raise DetectError(f"{self.name}: {error}") from None


def read_head(path: Path) -> FileHead:
    """Read the head of a file of rows.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    FileHead

    Raises
    ------
    DetectError
        If the file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            start = stream.read(_LONGEST_BYTES)
    except OSError as error:
        raise DetectError(f"{path}: cannot be read: {error.strerror}") from None
    comments: list[str] = []
    for line in start.decode("utf-8", "replace").splitlines():
        text = line.strip()
        if text and not text.startswith("#"):
            break
        comments.append(text.removeprefix("#").strip())
    settings = tuple(
        (name, value)
        for text in comments
        if text.startswith("settings ")
        for name, equals, value in (word.partition("=") for word in text.split()[1:])
        if equals
    )
    level = any(LEVELLED in text or LEVEL in text for text in comments)
    return FileHead(tuple(comments), settings, level, str(path))


def _line_values(settings: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """As `_values`, of `LineSettings`; of those that are several numbers, too."""
    entries = list(settings)
    singles = [entry for entry in entries if entry[0] not in (_PAIRS, _LIST)]
    values = _values(LineSettings, singles)
    for name, text in entries:
        if name not in (_PAIRS, _LIST):
            continue
        expected = "pairs of numbers" if name == _PAIRS else "numbers"
        try:
            numbers = tuple(float(word) for word in _NUMBERS.findall(text))
            pairs = zip(numbers[::2], numbers[1::2], strict=True)
            values[name] = tuple(pairs) if name == _PAIRS else numbers
        except ValueError:
            raise DetectError(f"{name} is {excerpt(text)}: expected {expected}") from None
    return values


def _values(kind: type, settings: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """The settings that a detector has, converted to their types."""
    known = {field.name for field in fields(kind)}
    return {name: parameter_value(kind, name, text) for name, text in settings if name in known}


@dataclass(frozen=True)
class FrameSelection:
    """Some frames of a run.

    Attributes
    ----------
    every : int
        Of the frames that are selected otherwise, only every so manieth.
    ranges : tuple of range
        Positions in the run.
    names : frozenset of str
        Images, as `detect.sources.image_names.image_name` gives them.

    Without ranges and names, all frames are selected.
    """

    every: int = 1
    ranges: tuple[range, ...] = ()
    names: frozenset[str] = frozenset()

    def expected(self, frames: Frames) -> int | None:
        """Approximate number of these frames; None if unknown."""
        if self.ranges or self.names or frames.expected is None:
            return None
        return -(-frames.expected // self.every)

    def of(self, frames: Frames) -> Iterator[tuple[int, RunFrame]]:
        """The selected frames, each with its position in the run, in the run's order."""
        everything = not (self.ranges or self.names)
        count = 0
        for position, frame in enumerate(frames):
            if (
                everything
                or any(position in part for part in self.ranges)
                or image_name(frame.step.prefix) in self.names
            ):
                if count % self.every == 0:
                    yield position, frame
                count += 1


def select_frames(frames: Frames, wanted: Sequence[str], every: int) -> FrameSelection:
    """Parse the selection of frames of a command line.

    Parameters
    ----------
    frames : Frames
        The run's.
    wanted : sequence of str
        Names of images, positions, and ranges FROM:TO[:STEP] of positions without the last. What is
        both a name and a position is a name.
    every : int
        Of these, every so manieth.

    Returns
    -------
    FrameSelection

    Raises
    ------
    DetectError
        If a name is no image's, a position is beyond the run, or no frame is left.
    """
    if every < 1:
        raise DetectError(f"every is {every}: expected 1 or more")
    if not wanted:
        return FrameSelection(every)
    asked = {image_name(word): word for word in wanted}
    names = [image_name(frame.step.prefix) for frame in frames]
    known = asked.keys() & set(names)
    ranges = [_positions(word, len(names)) for name, word in asked.items() if name not in known]
    return FrameSelection(every, tuple(ranges), frozenset(known))


def _positions(word: str, count: int) -> range:
    if word.isdecimal():
        if int(word) >= count:
            raise DetectError(f"frame {word}: expected a position from 0 to {count - 1}")
        return range(int(word), int(word) + 1)
    matched = _RANGE.fullmatch(word)
    if matched is None:
        raise DetectError(
            f"frame {word!r}: expected the name of an image of the run, a position or FROM:TO"
        )
    first, last, step = matched.groups()
    if step is not None and int(step) == 0:
        raise DetectError(f"frames {word}: the step is 0: expected 1 or more")
    positions = range(int(first or 0), min(int(last or count), count), int(step or 1))
    if not positions:
        raise DetectError(f"frames {word}: none of the run's {count} frames")
    return positions
