"""The flags of the commands that show, compare and export rows: one frozen dataclass per command.

Nothing heavy is imported: `--help` needs it all.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from detect.errors import CompareError
from detect.line_settings import LineSettings
from detect.options import (
    MaybeFloat,
    MaybeInt,
    MaybePath,
    MaybeStr,
    PickedFrames,
    Preset,
    RunFlags,
    SourceOptions,
)
from detect.settings import CircleSettings
from redetect.storage.bounds import ABOVE_0, NotNegative, Positive, demand_fields

ErrorCovariance = Literal["detected", "reference", "sum"]


@dataclass(frozen=True, kw_only=True)
class Gates:
    """Which detected and reference rows are the same landmark.

    Parameters
    ----------
    gate_m : float
        Compare discs on the floor: they are the same within this distance, metres. By default they
        are compared in the image where there is a calibration, and within 0.1 m where there is
        none.
    tolerance_deg : float
        Bearings of the same line differ by at most this,
    sigmas : float
        or by this many standard deviations of the detected one.
    """

    gate_m: Annotated[MaybeFloat, ABOVE_0] = None
    tolerance_deg: Positive = 0.5
    sigmas: NotNegative = 2.0

    def __post_init__(self) -> None:
        demand_fields(self, CompareError)


@dataclass(frozen=True, kw_only=True)
class CompareOptions(Gates):
    """Which rows are the same landmark, and which rows count.

    Parameters
    ----------
    sigma : float
        Compare discs on the floor: they are the same within this Mahalanobis distance under the
        reference row's covariance (standard deviations).
    least_px : float
        In the image, discs are the same if they differ by at most half the width and height of the
        disc's own image, or by this (px), whichever is more.
    only_identified : bool
        Count only reference rows that have an ID. Detected rows that fit a reference row without
        one are then neither right nor wrong: they are set aside.
    all_frames : bool
        Count frames that only one file has, too: all their rows are missed, or extra.
    error_covariance : {"detected", "reference", "sum"}
        Which covariance position errors of discs are measured in: the detected row's, the reference
        row's, or, where both err independently, their sum.
    """

    sigma: Annotated[MaybeFloat, ABOVE_0] = None
    least_px: Positive = 3.0
    only_identified: bool = False
    all_frames: bool = False
    error_covariance: ErrorCovariance = "detected"

    @property
    def on_floor(self) -> bool:
        """Whether discs are to be compared on the floor even where there is a calibration."""
        return self.gate_m is not None or self.sigma is not None


@dataclass(frozen=True)
class Compare:
    """Compare detected rows with reference rows: found, missed, look-alikes, clutter, errors.

    Example: detect compare images/e --min-recall 0.9, or: detect compare images/e --lines

    Parameters
    ----------
    run : Path
        Run folder.
    lines : bool
        Compare verticals instead of discs.
    reference : Path
        Reference rows; by default map.circles (map.lines) in the run folder.
    detected : Path
        Detected rows; by default detected.circles (detected.lines) in the run folder.
    unlisted : Path
        Discs that may be detected but need not be: rows on them are neither right nor wrong; by
        default unlisted.circles beside the reference, if it is there.
    lookalikes : Path
        What looks like a disc: extra rows on it are counted apart; by default lookalikes.circles
        beside the reference, if it is there.
    camera : Path
        Calibration, by default the one in the run folder: discs are compared in the image, each row
        where it was seen. Without one, or with --gate-m or --sigma, on the floor.
    min_recall : float
        Exit with 1 if the recall is lower.
    min_precision : float
        Exit with 1 if the precision is lower.
    json : Path
        Write the result as JSON.
    force : bool
        Replace an existing JSON file.
    """

    run: Positional[Path]
    lines: bool = False
    reference: MaybePath = None
    detected: MaybePath = None
    unlisted: MaybePath = None
    lookalikes: MaybePath = None
    camera: MaybePath = None
    min_recall: MaybeFloat = None
    min_precision: MaybeFloat = None
    json: MaybePath = None
    force: bool = False
    options: OmitArgPrefixes[CompareOptions] = field(default_factory=CompareOptions)


@dataclass(frozen=True)
class RowFiles:
    """Selects the files of rows.

    Parameters
    ----------
    rows : Path
        Folder with detected.circles, detected.lines, detected.markers and detected.tilt, as far as
        they exist; by default the run's.
    circles : Path
        Rows of discs, if not detected.circles there.
    lines : Path
        Rows of verticals, if not detected.lines there.
    markers : Path
        Rows of square markers, if not detected.markers there.
    tilt : Path
        Tilts of the frames, if not detected.tilt there.
    reference : Path
        Reference rows of discs, by default map.circles in the run folder if it exists.
    reference_lines : Path
        Reference rows of verticals, by default map.lines in the run folder if it exists.
    no_reference : bool
        Hold nothing against reference rows, not even where there are some.
    """

    rows: MaybePath = None
    circles: MaybePath = None
    lines: MaybePath = None
    markers: MaybePath = None
    tilt: MaybePath = None
    reference: MaybePath = None
    reference_lines: MaybePath = None
    no_reference: bool = False


@dataclass(frozen=True, kw_only=True)
class RowsFlags(RunFlags):
    """Options of all commands that show frames of a run."""

    source: SourceOptions = field(default_factory=SourceOptions)


@dataclass(frozen=True, kw_only=True)
class Draw(PickedFrames, RowsFlags):
    """Draw rows from files into the images: PNG files, or a video. Nothing is detected again.

    Example: detect all images/e, then: detect draw images/e -o /tmp/drawn --every 10

    Parameters
    ----------
    output : Path
        Folder for a PNG file per frame.
    video : Path
        Write an MP4 file as well, or instead.
    fps : float
        Frames of the video per second.
    """

    video: MaybePath = None
    fps: float = 10.0
    files: OmitArgPrefixes[RowFiles] = field(default_factory=RowFiles)
    gates: OmitArgPrefixes[Gates] = field(default_factory=Gates)


@dataclass(frozen=True, kw_only=True)
class View(PickedFrames, RowsFlags):
    """Frames, landmarks, tilt, path and map over time in Rerun (extra [view]).

    Example: detect all images/e, then: detect view images/e -o /tmp/e.rrd

    Parameters
    ----------
    output : Path
        The recording (.rrd) to write; without it, the viewer is started.
    path : Path
        The robot's path (path.csv of `slam map`); by default the sum of the STEP rows.
    map : Path
        Map to show (map.csv of `slam map`), in the frame of --path.
    force : bool
        Replace an existing recording.
    """

    path: MaybePath = None
    map: MaybePath = None
    files: OmitArgPrefixes[RowFiles] = field(default_factory=RowFiles)


@dataclass(frozen=True, kw_only=True)
class Report(RowsFlags):
    """One HTML page about a run: what was found, and how good it is against reference rows.

    Example: detect all images/e, then: detect report images/e -o /tmp/e.html

    Parameters
    ----------
    output : Path
        The page; by default detected.html in the run folder.
    worst : int
        How many of the worst frames are shown.
    time_frames : int
        Detect this many frames again, with the settings that the files name, and state how long
        that takes besides decoding; 0: none.
    force : bool
        Replace an existing page.
    """

    worst: int = 5
    time_frames: int = 0
    files: OmitArgPrefixes[RowFiles] = field(default_factory=RowFiles)
    gates: OmitArgPrefixes[Gates] = field(default_factory=Gates)


if TYPE_CHECKING:

    class Grid:
        """One `str` or None for each field of `CircleSettings` and of `LineSettings`."""

else:

    def _grid() -> type:
        def values_of(name: str) -> object:
            return Annotated[MaybeStr, arg(metavar="VALUES", help=f"Values of {name}.")]

        names = {f.name: None for kind in (CircleSettings, LineSettings) for f in fields(kind)}
        # Several numbers are no value of a grid.
        del names["refine_steps_px"], names["blurred_widths"]
        return make_dataclass(
            "Grid",
            [(name, values_of(name), field(default=None)) for name in names],
            namespace={"__doc__": "Parameters to be varied: FROM:TO:STEP, or values with commas."},
            frozen=True,
        )

    Grid = _grid()


@dataclass(frozen=True, kw_only=True)
class Tune(PickedFrames, RowsFlags):
    """Try parameters over a grid against a reference file: precision and recall, knee marked.

    Example: detect tune images/e --threshold 0.3:0.7:0.1 --every 8 -o /tmp/tuned

    Any parameter of `detect circles` (with --verticals: of `detect lines`) can be varied: by
    FROM:TO:STEP, both ends included, or by values with commas between them. All combinations are
    tried.

    Parameters
    ----------
    output : Path
        Folder for table.csv, table.json and curve.png; by default `detected.tune`
        in the run folder.
    verticals : bool
        Tune the detector of verticals instead of that of discs.
    preset : str
        `default` or `published`: the values of all parameters that are not varied.
    reference : Path
        Reference rows; by default map.circles (map.lines) in the run folder.
    tilt : Path
        Tilts of the frames: positions of discs are corrected for them.
    only_identified : bool
        Count only reference rows that have an ID.
    most : int
        Refuse grids of more combinations than this.
    jobs : int
        Processes that share the work, 1 for none beside this one; by default one for every 500
        frames to process, at most as many as there are cores. What is written is the same.
    """

    verticals: bool = False
    preset: Preset = "default"
    reference: MaybePath = None
    tilt: MaybePath = None
    only_identified: bool = False
    most: int = 1000
    jobs: MaybeInt = None
    gates: OmitArgPrefixes[Gates] = field(default_factory=Gates)
    grid: OmitArgPrefixes[Grid] = field(default_factory=Grid)


Format = Literal["csv", "parquet", "mcap"]


@dataclass(frozen=True)
class Export:
    """Write the rows of a file in another format, with named columns and units.

    Example: detect export images/e/map.circles --to csv -o /tmp/discs.csv, or:
    detect export drive.detected.circles --to mcap

    Cameras of COLMAP come from the calibration: camera convert e.cam cameras.txt

    Parameters
    ----------
    file : Path
        A .circles, .lines, .markers or .tilt file, or one of STEP rows.
    to : str
        csv, with a line of names and units; parquet (extra [parquet]); or mcap, messages of ROS 2
        (extra [bags]).
    output : Path
        The file to write; by default the file's name and the format's. The steps go beside it, as
        .steps.csv or .steps.parquet; MCAP has all in one.
    times : Path
        Times of the frames, rows `prefix seconds`; by default <file>.times, or that of what was
        detected together (detected.times).
    rate_hz : float
        Frame rate to use without times, the first frame at 0 s. MCAP needs one or the other.
    force : bool
        Replace existing files.
    """

    file: Positional[Path]
    to: Format = "csv"
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    times: MaybePath = None
    rate_hz: MaybeFloat = None
    force: bool = False
