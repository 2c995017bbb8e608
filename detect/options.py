"""The flags of the commands: one frozen dataclass per command, and shared ones.

Imports nothing heavy, since `--help` needs this module.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg

from detect.errors import CompareError, DetectError
from detect.line_settings import LineSettings
from detect.settings import CircleSettings, Levelling, MarkerSettings
from redetect.bounds import (
    ABOVE_0,
    SHARE,
    Bounded,
    MaybeFloat,
    MaybeInt,
    MaybePath,
    MaybePixel,
    MaybeStr,
    NotNegative,
    Positive,
    whole,
)

#: More than any run has.
MOST_FRAMES = 10**9
Preset = Literal["default", "published"]
DetectorPreset = Literal["default", "published", "report"]


@dataclass(frozen=True)
class SourceOptions(Bounded, error=DetectError):
    """Options of a source besides its name."""

    #: Source of the steps, if not the image source itself: a TUM trajectory (.tum; rows t x y z qx
    #: qy qz qw, X forward), wheel encoder counts (.ticks; rows t left right), velocities
    #: (.velocities; rows t v omega sigma_v sigma_omega), a file of STEP rows of image files, a
    #: nav_msgs/Odometry topic of the bag (/odom), or none.
    odometry: str = ""
    wheel_base_m: NotNegative = 0.0  #: Distance between the two wheels, for .ticks.
    metres_per_tick: NotNegative = 0.0  #: Distance that a wheel travels per tick.
    #: File of the images' times, rows `prefix seconds`; by default <folder>.times among the images.
    times: str = ""
    image_topic: str = ""  #: Image topic of a bag, if there are several.
    #: Bits of values that are stored in 16; by default the fewest that hold those of some images.
    bit_depth: Annotated[MaybeInt, whole(8, 16)] = None
    #: Stop after this many frames; 0 for all of them (with a live camera: until Ctrl-C).
    frames: Annotated[int, whole(0, MOST_FRAMES)] = 0


@dataclass(frozen=True, kw_only=True)
class RunFlags(Bounded, error=DetectError):
    """Options of all commands that process the frames of a run."""

    #: Run folder, folder or pattern of images, video or bag, as for `detect circles`.
    run: Positional[Path]
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None  #: The file to write.
    camera: MaybePath = None  #: Calibration, if not the one in the run folder.
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
        camera:0. The .cam file is beside it, or given by --camera.
    output : Path
        The file to write; by default detected.circles, .lines or .markers in the run folder, or
        named after the video or bag and beside it.
    """

    #: JSON file with defaults of the other flags: from `detect tune --serve`, or a result's
    #: .log.json, to detect with the same settings again.
    settings: MaybePath = None
    #: Line ends of landmark files; the data set's own files have CR and LF.
    line_ends: Literal["lf", "crlf"] = "lf"
    #: Number of processes; by default one for every 500 frames, up to the number of cores. The
    #: output does not depend on it.
    jobs: MaybeInt = None
    #: Address of a dask scheduler (tcp://host:8786) whose workers process the frames instead.
    cluster: MaybeStr = None
    #: Stop at the first frame that cannot be processed, with exit code 1 and no output.
    strict: bool = False
    #: Continue an unfinished run of the same command after the frames it has processed.
    resume: bool = False


@dataclass(frozen=True, kw_only=True)
class DiscIdOptions:
    """Sources of the IDs of discs."""

    #: A .circles file whose IDs are transferred to rows of the same discs, levelled or not.
    ids_from: MaybePath = None
    #: A map (map.csv of `slam map`): rows without an ID from --ids-from get the ID of the map's
    #: disc at their position (needs --path).
    ids_from_map: MaybePath = None
    path: MaybePath = None  #: The frames' poses in that map (path.csv of `slam map`).


@dataclass(frozen=True, kw_only=True)
class Circles(DetectorFlags):
    """Detect the discs of a run and write them to a .circles file.

    Example: detect circles images/e --draw /tmp/discs, or:
    detect circles drive.mcap --camera front.cam --odometry /odom
    """

    #: Defaults of the other flags: `published` reproduces the data set's rows (all of them and only
    #: those), `report` has the parameters that the report prints.
    preset: DetectorPreset = "default"
    #: Tilt for which discs are corrected: that of the frames in a file (from `detect lines`), or
    #: `none`. By default they are not corrected either, but some images are examined for how much
    #: the robot tilts, which covariances include.
    tilt: MaybePath = None
    #: Estimate the radius of the discs from some images first; the same as --radius-m auto.
    find_radius: bool = False
    ids: OmitArgPrefixes[DiscIdOptions] = field(default_factory=DiscIdOptions)
    #: Folder for images with outlines and qualities drawn in, after detection.
    draw: MaybePath = None
    #: Also write the rows as JSON, with pixels and evidence; -: to standard output only.
    json: MaybePath = None
    detector: OmitArgPrefixes[CircleSettings] = field(default_factory=CircleSettings)


@dataclass(frozen=True, kw_only=True)
class Lines(DetectorFlags):
    """Detect the verticals of a run and write them to a .lines file, and the tilt to a .tilt file.

    Example: detect lines images/e --join-threshold 0.006, or:
    detect lines drive.avi --camera front.cam --frames 100
    """

    #: Defaults of the other flags: `published` reproduces the data set's own rows as far as they
    #: are known, `report` has the parameters that the report prints.
    preset: DetectorPreset = "default"
    #: The tilt file to write; by default the output's name with the extension .tilt.
    tilt_output: MaybePath = None
    #: A .lines file whose IDs are transferred where the match is unambiguous.
    ids_from: MaybePath = None
    #: Folder for images with lines and their standard deviations drawn in, after detection.
    draw: MaybePath = None
    #: Draw all tracks instead, rejected ones with the reason; repeats the detection.
    rejected: bool = False
    detector: OmitArgPrefixes[LineSettings] = field(default_factory=LineSettings)


@dataclass(frozen=True, kw_only=True)
class Markers(DetectorFlags):
    """Detect the square markers of a run and write them to a .markers file.

    Example: detect markers images/m/a --dictionary rawseeds, or:
    detect markers camera:0 --frames 100

    Without a calibration, edges are assumed to be straight in the images.
    """

    #: Folder for images with the markers drawn in, after detection.
    draw: MaybePath = None
    rejected: bool = False  #: Also draw rejected candidates; repeats the detection.
    detector: OmitArgPrefixes[MarkerSettings] = field(default_factory=MarkerSettings)


@dataclass(frozen=True, kw_only=True)
class All(DetectorFlags):
    """Detect verticals, tilt and discs of a run, and correct the discs for the tilt.

    Example: detect all images/e --polarity light, or:
    detect all 'drive/*.png' --camera front.cam --times drive.times --odometry drive.tum

    Parameters
    ----------
    output : Path
        Folder for detected.circles, detected.lines and detected.tilt; by default the run's, or
        named after the video or bag and beside it.
    """

    preset: Preset = "default"  #: Defaults of the other flags.
    ids: OmitArgPrefixes[DiscIdOptions] = field(default_factory=DiscIdOptions)
    #: A .lines file whose IDs are transferred where the match is unambiguous.
    line_ids_from: MaybePath = None
    #: Tilt for which discs are corrected: `none`, that of the single `frame`, or that of the `run`
    #: (a constant lean, and the estimated deviation of each frame from it).
    tilt: Levelling = "run"
    #: Estimate the radius of the discs from some images first, the same as --radius-m auto.
    find_radius: bool = False
    circles: OmitArgPrefixes[CircleSettings] = field(default_factory=CircleSettings)
    lines: OmitArgPrefixes[LineSettings] = field(default_factory=LineSettings)


@dataclass(frozen=True, kw_only=True)
class CompareOptions(Bounded, error=CompareError):
    """How detected and reference rows are matched, and which rows count."""

    #: Match discs on the floor within this distance, metres. By default they are matched in the
    #: image if there is a calibration, and within 0.1 m otherwise.
    gate_m: Annotated[MaybeFloat, ABOVE_0] = None
    tolerance_deg: Positive = 0.5  #: Largest difference of bearings of the same line, degrees.
    sigmas: NotNegative = 2.0  #: The same in standard deviations; the larger of both applies.
    #: Count only reference rows that have an ID. Detected rows that match a reference row without
    #: one are set aside, neither right nor wrong.
    only_identified: bool = False


@dataclass(frozen=True)
class Compare(Bounded, error=CompareError):
    """Compare detected rows with reference rows: found, missed, look-alikes, clutter, errors.

    Example: detect compare images/e --min-recall 0.9, or: detect compare images/e --lines
    """

    run: Positional[Path]  #: Run folder.
    lines: bool = False  #: Compare verticals instead of discs.
    #: Reference rows; by default map.circles (map.lines) in the run folder.
    reference: MaybePath = None
    #: Detected rows; by default detected.circles (detected.lines) in the run folder.
    detected: MaybePath = None
    #: Discs (lines) that may be detected but need not be: rows that match them are neither right
    #: nor wrong; by default unlisted.circles (unlisted.lines) beside the reference, if it exists.
    unlisted: MaybePath = None
    #: Calibration, by default the one in the run folder: discs are compared in the image, where
    #: they were seen. Without one, or with --gate-m, they are compared on the floor.
    camera: MaybePath = None
    min_recall: Annotated[MaybeFloat, SHARE] = None  #: Exit with 1 if the recall is lower.
    min_precision: Annotated[MaybeFloat, SHARE] = None  #: Exit with 1 if the precision is lower.
    json: MaybePath = None  #: Write the result as JSON; -: to standard output only.
    force: bool = False  #: Replace an existing JSON file.
    matching: OmitArgPrefixes[CompareOptions] = field(default_factory=CompareOptions)


@dataclass(frozen=True)
class RowFiles:
    """Selects the files of rows."""

    #: Folder with those of detected.circles, detected.lines, detected.markers and detected.tilt
    #: that exist; by default the run's.
    rows: MaybePath = None
    #: Reference rows of discs, by default map.circles in the run folder if it exists.
    reference: MaybePath = None
    #: Reference rows of verticals, by default map.lines in the run folder if it exists.
    reference_lines: MaybePath = None


@dataclass(frozen=True, kw_only=True)
class SomeFramesFlags(RunFlags):
    """Options of commands that may skip frames."""

    every: Annotated[int, whole(1, MOST_FRAMES)] = 1  #: Only every n-th frame.


@dataclass(frozen=True, kw_only=True)
class Draw(SomeFramesFlags):
    """Draw rows from files into the images, without detection: PNG files, or a video.

    Example: detect all images/e, then: detect draw images/e -o /tmp/drawn --every 10

    Parameters
    ----------
    output : Path
        Folder for a PNG file per frame.
    """

    video: MaybePath = None  #: Write an MP4 file as well, or instead.
    fps: Annotated[MaybeFloat, ABOVE_0] = None  #: Frames per second of the video, by default 10.
    files: OmitArgPrefixes[RowFiles] = field(default_factory=RowFiles)


@dataclass(frozen=True, kw_only=True)
class View(SomeFramesFlags):
    """Show frames, landmarks, tilt, path and map over time in Rerun (extra [view]).

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
    """Write an HTML page about a run: detections, and their comparison with reference rows.

    Example: detect all images/e, then: detect report images/e -o /tmp/e.html

    Parameters
    ----------
    output : Path
        The page; by default detected.html in the run folder.
    force : bool
        Replace an existing page.
    """

    worst: Annotated[int, whole(0)] = 5  #: Number of worst frames to show.
    files: OmitArgPrefixes[RowFiles] = field(default_factory=RowFiles)


@dataclass(frozen=True, kw_only=True)
class Explain(Bounded, error=DetectError):
    """Explain why discs of an image are found or not: each candidate, and what rejected it.

    Example: detect explain images/e/images/e.0000.jpg --at 377 85 -o /tmp/why.png
    """

    image: Positional[Path]  #: The image.
    #: Pixel (u, v) of something that should have been found; only candidates near it are explained.
    at: MaybePixel = None
    #: Calibration; by default the one in the image's folder, or in its parent.
    camera: MaybePath = None
    #: Bits of values that are stored in 16; by default the fewest that hold those of the image.
    bit_depth: Annotated[MaybeInt, whole(8, 16)] = None
    #: PNG file for a picture of the candidates, numbered as in the table.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    json: MaybePath = None  #: Write the candidates as JSON; -: to standard output.
    force: bool = False  #: Replace existing files.
    settings: MaybePath = None  #: JSON file with defaults of the other flags.
    detector: OmitArgPrefixes[CircleSettings] = field(default_factory=CircleSettings)


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Detect discs, verticals and tilt of a small run, compare them with the truth, write a page.

    Example: detect demo -o /tmp/demo

    The run is rendered: a robot drives along a corridor, and all true positions are known.
    """

    #: Another run to use, with map.circles as the truth; by default images included in the
    #: program.
    run: MaybePath = None
    #: Folder for the rows and the page; by default redetect-demo in the working folder.
    output: Annotated[Path, arg(aliases=["-o"])] = Path("redetect-demo")
    force: bool = False  #: Replace existing files.


@dataclass(frozen=True, kw_only=True)
class Tune(SomeFramesFlags):
    """Evaluate parameters over a grid against reference rows: precision, recall and their knee.

    Example: detect tune images/e --vary evidence=-1:3:0.5 --every 8 -o /tmp/tuned

    All combinations of the values of --vary are tried. With --serve, parameters are changed by hand
    on a page instead, which needs no reference rows; discs can be labelled there.

    Parameters
    ----------
    output : Path
        Folder for table.json and curve.png, or for the files that the page saves: tuned.json
        (settings, for --settings) and labels.circles; by default `detected.tune` in the run folder.
    """

    #: Parameters of `detect circles` and their values: NAME=FROM:TO:STEP, both ends included, or
    #: NAME=VALUES with commas between them.
    vary: UseAppendAction[tuple[tuple[str, ...], ...]] = ()
    serve: bool = False  #: Serve a page for tuning the settings of discs, until Ctrl-C.
    port: Annotated[int, whole(0, 65535)] = 0  #: Port of the page; 0: any free port.
    settings: MaybePath = None  #: JSON file with the values that are not varied.
    reference: MaybePath = None  #: Reference rows; by default map.circles in the run folder.
    #: Number of processes; by default one for every 500 frames to process, up to the number of
    #: cores. The output does not depend on it.
    jobs: MaybeInt = None
    matching: OmitArgPrefixes[CompareOptions] = field(default_factory=CompareOptions)


@dataclass(frozen=True)
class Export(Bounded, error=DetectError):
    """Write the rows of a file in another format, with named columns and units.

    Example: detect export images/e/map.circles --to csv -o /tmp/discs.csv, or:
    detect export drive.detected.circles --to mcap

    Cameras of COLMAP come from the calibration: camera convert e.cam cameras.txt
    """

    file: Positional[Path]  #: A .circles, .lines, .markers or .tilt file, or one of STEP rows.
    #: csv, with a line of names and units; parquet (extra [parquet]); or mcap, messages of ROS 2
    #: (extra [bags]).
    to: Literal["csv", "parquet", "mcap"] = "csv"
    #: The file to write; by default the file's name with the format's extension. Steps are written
    #: beside it, as .steps.csv or .steps.parquet; MCAP has everything in one file.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    #: Times of the frames, rows `prefix seconds`; by default <file>.times, or that of what was
    #: detected together (detected.times).
    times: MaybePath = None
    #: Frame rate to use without times, the first frame at 0 s. MCAP needs one or the other.
    rate_hz: Annotated[MaybeFloat, ABOVE_0] = None
    force: bool = False  #: Replace existing files.
