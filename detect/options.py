"""The flags of the detectors, a frozen dataclass per command, and those that others share.

Nothing heavy is imported: `--help` needs it all.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.settings import CircleSettings, Levelling, MarkerSettings
from redetect.storage.bounds import (
    MaybeFloat,
    MaybeInt,
    MaybePath,
    MaybeStr,
    NotNegative,
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
