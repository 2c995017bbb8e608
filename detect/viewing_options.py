"""The flags of the commands that show, compare and export rows: one frozen dataclass per command.

Nothing heavy is imported: `--help` needs it all.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from detect.errors import CompareError, DetectError
from detect.options import RunFlags
from detect.settings import CircleSettings
from redetect.storage.bounds import (
    ABOVE_0,
    MaybeFloat,
    MaybeInt,
    MaybePath,
    MaybePixel,
    NotNegative,
    Positive,
    demand_fields,
    whole,
)


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """Which detected and reference rows are the same landmark, and which rows count."""

    #: Compare discs on the floor: they are the same within this distance, metres. By default they
    #: are compared in the image where there is a calibration, and within 0.1 m where there is none.
    gate_m: Annotated[MaybeFloat, ABOVE_0] = None
    tolerance_deg: Positive = 0.5  #: Bearings of the same line differ by at most this,
    sigmas: NotNegative = 2.0  #: or by this many standard deviations of the detected one.
    #: Count only reference rows that have an ID. Detected rows that fit a reference row without one
    #: are then neither right nor wrong: they are set aside.
    only_identified: bool = False

    def __post_init__(self) -> None:
        demand_fields(self, CompareError)


@dataclass(frozen=True)
class Compare:
    """Compare detected rows with reference rows: found, missed, look-alikes, clutter, errors.

    Example: detect compare images/e --min-recall 0.9, or: detect compare images/e --lines
    """

    run: Positional[Path]  #: Run folder.
    lines: bool = False  #: Compare verticals instead of discs.
    #: Reference rows; by default map.circles (map.lines) in the run folder.
    reference: MaybePath = None
    #: Detected rows; by default detected.circles (detected.lines) in the run folder.
    detected: MaybePath = None
    #: Discs (lines) that may be detected but need not be: rows on them are neither right nor wrong;
    #: by default unlisted.circles (unlisted.lines) beside the reference, if it is there.
    unlisted: MaybePath = None
    #: Calibration, by default the one in the run folder: discs are compared in the image, each row
    #: where it was seen. Without one, or with --gate-m, on the floor.
    camera: MaybePath = None
    min_recall: MaybeFloat = None  #: Exit with 1 if the recall is lower.
    min_precision: MaybeFloat = None  #: Exit with 1 if the precision is lower.
    json: MaybePath = None  #: Write the result as JSON; -: to standard output, alone.
    force: bool = False  #: Replace an existing JSON file.
    matching: OmitArgPrefixes[CompareOptions] = field(default_factory=CompareOptions)


@dataclass(frozen=True)
class RowFiles:
    """Selects the files of rows."""

    #: Folder with detected.circles, detected.lines, detected.markers and detected.tilt, as far as
    #: they exist; by default the run's.
    rows: MaybePath = None
    #: Reference rows of discs, by default map.circles in the run folder if it exists.
    reference: MaybePath = None
    #: Reference rows of verticals, by default map.lines in the run folder if it exists.
    reference_lines: MaybePath = None


@dataclass(frozen=True, kw_only=True)
class SomeFramesFlags(RunFlags):
    """Options of commands that may leave frames out."""

    every: Annotated[int, whole(1)] = 1  #: Only every n-th frame.

    def __post_init__(self) -> None:
        demand_fields(self, DetectError)


@dataclass(frozen=True, kw_only=True)
class Draw(SomeFramesFlags):
    """Draw rows from files into the images: PNG files, or a video. Nothing is detected again.

    Example: detect all images/e, then: detect draw images/e -o /tmp/drawn --every 10

    Parameters
    ----------
    output : Path
        Folder for a PNG file per frame.
    """

    video: MaybePath = None  #: Write an MP4 file as well, or instead.
    fps: float = 10.0  #: Frames of the video per second.
    files: OmitArgPrefixes[RowFiles] = field(default_factory=RowFiles)


@dataclass(frozen=True, kw_only=True)
class View(SomeFramesFlags):
    """Frames, landmarks, tilt, path and map over time in Rerun (extra [view]).

    Example: detect all images/e, then: detect view images/e -o /tmp/e.rrd

    Parameters
    ----------
    output : Path
        The recording (.rrd) to write; without it, the viewer is started.
    force : bool
        Replace an existing recording.
    """

    #: The robot's path (path.csv of `slam map`); by default the sum of the STEP rows.
    path: MaybePath = None
    map: MaybePath = None  #: Map to show (map.csv of `slam map`), in the frame of --path.
    files: OmitArgPrefixes[RowFiles] = field(default_factory=RowFiles)


@dataclass(frozen=True, kw_only=True)
class Report(RunFlags):
    """One HTML page about a run: what was found, and how good it is against reference rows.

    Example: detect all images/e, then: detect report images/e -o /tmp/e.html

    Parameters
    ----------
    output : Path
        The page; by default detected.html in the run folder.
    force : bool
        Replace an existing page.
    """

    worst: int = 5  #: How many of the worst frames are shown.
    files: OmitArgPrefixes[RowFiles] = field(default_factory=RowFiles)


@dataclass(frozen=True, kw_only=True)
class Explain:
    """Why discs of an image are found, or not: each candidate, and the number that dropped it.

    Example: detect explain images/e/images/e.0000.jpg --at 377 85 -o /tmp/why.png
    """

    image: Positional[Path]  #: The image.
    #: Pixel (u, v) of something that should have been found: only what is near it is explained.
    at: MaybePixel = None
    #: Calibration; by default the one in the image's folder, or in the folder of that.
    camera: MaybePath = None
    #: PNG file for a picture of the candidates, numbered as in the table.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    json: MaybePath = None  #: Write the candidates as JSON; -: to standard output.
    force: bool = False  #: Replace existing files.
    settings: MaybePath = None  #: JSON file with the values that the other flags start from.
    parameters: OmitArgPrefixes[CircleSettings] = field(default_factory=CircleSettings)


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Detect discs, verticals and tilt of a small run, compare them with the truth, make a page.

    Example: detect demo -o /tmp/demo

    The run is rendered: a robot's camera drives along a corridor, and where everything is is known.
    """

    #: Another run to use, with map.circles as the truth; by default images that come with the
    #: program.
    run: MaybePath = None
    #: Folder for the rows and the page; by default redetect-demo in the working folder.
    output: Annotated[Path, arg(aliases=["-o"])] = Path("redetect-demo")
    force: bool = False  #: Replace existing files.


@dataclass(frozen=True, kw_only=True)
class Tune(SomeFramesFlags):
    """Try parameters over a grid against a reference file: precision and recall, knee marked.

    Example: detect tune images/e --vary evidence=-1:3:0.5 --every 8 -o /tmp/tuned

    All combinations of the values of --vary are tried. With --serve, parameters are turned by hand
    on a page instead, which needs no reference rows, and labels discs.

    Parameters
    ----------
    output : Path
        Folder for table.json and curve.png, or for what the page saves: tuned.json
        (settings, for --settings) and labels.circles; by default `detected.tune` in the run folder.
    """

    #: Parameters of `detect circles` and their values: NAME=FROM:TO:STEP, both ends included, or
    #: NAME=VALUES with commas between them.
    vary: tuple[str, ...] = ()
    serve: bool = False  #: Serve a page for turning the settings of discs, until Ctrl-C.
    port: Annotated[int, whole(0, 65535)] = 0  #: Port of the page; 0: any that is free.
    settings: MaybePath = None  #: JSON file with the values that are not varied.
    reference: MaybePath = None  #: Reference rows; by default map.circles in the run folder.
    #: Processes that share the work, 1 for none beside this one; by default one for every 500
    #: frames to process, at most as many as there are cores. What is written is the same.
    jobs: MaybeInt = None
    matching: OmitArgPrefixes[CompareOptions] = field(default_factory=CompareOptions)


@dataclass(frozen=True)
class Export:
    """Write the rows of a file in another format, with named columns and units.

    Example: detect export images/e/map.circles --to csv -o /tmp/discs.csv, or:
    detect export drive.detected.circles --to mcap

    Cameras of COLMAP come from the calibration: camera convert e.cam cameras.txt
    """

    file: Positional[Path]  #: A .circles, .lines, .markers or .tilt file, or one of STEP rows.
    #: csv, with a line of names and units; parquet (extra [parquet]); or mcap, messages of ROS 2
    #: (extra [bags]).
    to: Literal["csv", "parquet", "mcap"] = "csv"
    #: The file to write; by default the file's name and the format's. The steps go beside it, as
    #: .steps.csv or .steps.parquet; MCAP has all in one.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    #: Times of the frames, rows `prefix seconds`; by default <file>.times, or that of what was
    #: detected together (detected.times).
    times: MaybePath = None
    #: Frame rate to use without times, the first frame at 0 s. MCAP needs one or the other.
    rate_hz: MaybeFloat = None
    force: bool = False  #: Replace existing files.
