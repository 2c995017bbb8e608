"""The flags of the commands: one frozen dataclass per command, and those that several share.

Nothing heavy is imported: `--help` needs it all.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from detect.errors import CompareError, DetectError
from detect.line_settings import LineSettings
from detect.settings import CircleSettings, Levelling, MarkerSettings
from redetect.storage.bounds import (
    ABOVE_0,
    MaybeFloat,
    MaybeInt,
    MaybePath,
    MaybePixel,
    MaybeStr,
    NotNegative,
    Positive,
    demand_fields,
    whole,
)

Preset = Literal["default", "published"]
DetectorPreset = Literal["default", "published", "report"]


@dataclass(frozen=True)
class SourceOptions:
    """Options of a source besides its name."""

    #: Where the steps come from, if not from the source itself: a TUM trajectory (.tum; rows t x y
    #: z qx qy qz qw, X forward), counters of two wheels (.ticks; rows t left right), a file of STEP
    #: rows of image files, a nav_msgs/Odometry topic of the bag (/odom), or none.
    odometry: str = ""
    wheel_base_m: NotNegative = 0.0  #: Distance of the two wheels whose ticks are counted.
    metres_per_tick: NotNegative = 0.0  #: Way of a wheel from one tick to the next.
    #: File of the images' times, rows `prefix seconds`; by default <folder>.times among the images.
    times: str = ""
    image_topic: str = ""  #: The images of a bag, if there are several topics of them.
    #: Stop after this many frames; 0 for all of them (of a live camera: until Ctrl-C).
    frames: Annotated[int, whole(0)] = 0

    def __post_init__(self) -> None:
        demand_fields(self, DetectError)


@dataclass(frozen=True, kw_only=True)
class RunFlags:
    """Options of all commands that process the frames of a run."""

    #: Run folder, folder or pattern of images, video or bag, as for `detect circles`.
    run: Positional[Path]
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None  #: The file to write.
    camera: MaybePath = None  #: Calibration, if it is not the one in the run folder.
    force: bool = False  #: Replace existing files.
    source: OmitArgPrefixes[SourceOptions] = field(default_factory=SourceOptions)


@dataclass(frozen=True, kw_only=True)
class DetectorFlags(RunFlags):
    """Options of all detectors besides their settings.

    Parameters
    ----------
    run : Path
        Run folder of the data set's layout; a folder of images, or a pattern in quotes
        ('drive/*.png'); a video; a ROS 1 or 2 bag or MCAP file; or a camera of this machine,
        camera:0. With a .cam beside it, or named by --camera.
    output : Path
        The file to write; by default detected.circles, .lines or .markers in the run folder, or
        named after the video or bag and beside it.
    """

    #: JSON file with the values that the other flags start from: that of `detect tune --serve`, or
    #: a result's .log.json, to detect with the same ones again.
    settings: MaybePath = None
    #: How lines end in files of landmarks; the data set's own end with CR and LF.
    line_ends: Literal["lf", "crlf"] = "lf"
    #: Processes that share the work, 1 for none beside this one; by default one for every 500
    #: frames, at most as many as there are cores. What is written is the same.
    jobs: MaybeInt = None
    #: Address of a dask scheduler (tcp://host:8786) whose workers do the work instead.
    cluster: MaybeStr = None
    #: Stop at the first frame that cannot be worked on, with exit code 1 and nothing written.
    strict: bool = False
    #: Take over the frames that an unfinished run of the same command kept, and go on after them.
    resume: bool = False


@dataclass(frozen=True, kw_only=True)
class DiscIdOptions:
    """Where the IDs of discs come from."""

    #: A .circles file whose IDs are carried over to the rows of the same discs, levelled or not.
    ids_from: MaybePath = None
    #: A map (map.csv of `slam map`): rows without an ID by --ids-from get the ID of the disc they
    #: fall on,
    ids_from_map: MaybePath = None
    path: MaybePath = None  #: seen from the frame's pose in this path (path.csv of `slam map`).


@dataclass(frozen=True, kw_only=True)
class Circles(DetectorFlags):
    """Detect the discs of a run and write them to a .circles file.

    Example: detect circles images/e --draw /tmp/discs, or:
    detect circles drive.mcap --camera front.cam --odometry /odom

    Parameters
    ----------
    preset : str
        Values that the other flags start from: `published` is the detector that made the data set's
        rows (all of them and only those), `report` what the report prints of it.
    """

    preset: DetectorPreset = "default"
    #: Tilts of the frames (written by `detect lines`): positions are corrected for them.
    tilt: MaybePath = None
    #: Find the radius of the discs in some of the images first; so says --radius-m auto, too.
    find_radius: bool = False
    ids: OmitArgPrefixes[DiscIdOptions] = field(default_factory=DiscIdOptions)
    #: Folder for images with the outlines and qualities drawn in, once all is detected.
    draw: MaybePath = None
    #: Write the rows with their pixels and evidence as JSON as well; -: to standard output, alone.
    json: MaybePath = None
    parameters: OmitArgPrefixes[CircleSettings] = field(default_factory=CircleSettings)


@dataclass(frozen=True, kw_only=True)
class Lines(DetectorFlags):
    """Detect the verticals of a run and write them to a .lines file, and the tilt to a .tilt file.

    Example: detect lines images/e --join-threshold 0.006, or:
    detect lines drive.avi --camera front.cam --frames 100

    Parameters
    ----------
    preset : str
        Values that the other flags start from: `published` gives the data set's own rows as far as
        they are known, `report` is what the report prints of their detector.
    """

    preset: DetectorPreset = "default"
    #: The tilt file to write; by default the output's name with the ending .tilt.
    tilt: MaybePath = None
    #: A .lines file whose IDs are carried over where the match is unambiguous.
    ids_from: MaybePath = None
    #: Lines whose bearings are closer than this (radians) are joined; overrides `--join-px`.
    join_threshold: MaybeFloat = None
    #: Folder for images with the lines and their standard deviations drawn in, once all is
    #: detected.
    draw: MaybePath = None
    #: Draw all tracks instead, the rejected ones with the reason; detects once more.
    rejected: bool = False
    parameters: OmitArgPrefixes[LineSettings] = field(default_factory=LineSettings)


@dataclass(frozen=True, kw_only=True)
class Markers(DetectorFlags):
    """Detect the square markers of a run and write them to a .markers file.

    Example: detect markers images/m/a --dictionary rawseeds, or:
    detect markers camera:0 --frames 100

    Without a calibration, edges are taken to be straight in the images.
    """

    #: Folder for images with the markers drawn in, once all are detected.
    draw: MaybePath = None
    rejected: bool = False  #: Draw what was rejected as well; detects once more.
    parameters: OmitArgPrefixes[MarkerSettings] = field(default_factory=MarkerSettings)


@dataclass(frozen=True, kw_only=True)
class All(DetectorFlags):
    """Detect verticals, tilt and discs of a run; --tilt corrects the discs' positions for it.

    Example: detect all images/e --circles.polarity light, or:
    detect all 'drive/*.png' --camera front.cam --times drive.times --odometry drive.tum

    Parameters
    ----------
    output : Path
        Folder for detected.circles, detected.lines and detected.tilt; by default the run's, or
        named after the video or bag and beside it.
    """

    preset: Preset = "default"  #: Values that the other flags start from.
    ids: OmitArgPrefixes[DiscIdOptions] = field(default_factory=DiscIdOptions)
    #: A .lines file whose IDs are carried over where the match is unambiguous.
    line_ids_from: MaybePath = None
    #: What levels the discs: `none`, the tilt of the single `frame`, or the `run`'s (a constant
    #: lean, and the estimated deviation of each frame from it).
    tilt: Levelling = "run"
    #: Find the radius of the discs in some of the images first; so says --circles.radius-m auto,
    #: too.
    find_radius: bool = False
    circles: CircleSettings = field(default_factory=CircleSettings)
    lines: LineSettings = field(default_factory=LineSettings)


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
