"""The flags of the detectors, a frozen dataclass per command, and those that others share.

Nothing heavy is imported: `--help` needs it all.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Optional

from tyro.conf import OmitArgPrefixes, Positional, arg

from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.markers.settings import MarkerSettings
from detect.settings import CircleSettings, Levelling
from redetect.storage.bounds import NotNegative, demand_fields, whole

# For `X | None` tyro imports another library that takes a tenth of a second.
MaybePath = Optional[Path]  # noqa: UP045
MaybeInt = Optional[int]  # noqa: UP045
MaybeFloat = Optional[float]  # noqa: UP045
MaybeStr = Optional[str]  # noqa: UP045

Preset = Literal["default", "published"]
DiscPreset = Literal["default", "published", "report"]
LineEnds = Literal["lf", "crlf"]


@dataclass(frozen=True, kw_only=True)
class RunFlags:
    """Options of all commands that process the frames of a run.

    Parameters
    ----------
    run : Path
        Run folder, folder or pattern of images, video or bag, as for `detect circles`.
    output : Path
        The file to write.
    camera : Path
        Calibration, if it is not the one in the run folder.
    force : bool
        Replace existing files.
    """

    run: Positional[Path]
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    camera: MaybePath = None
    force: bool = False


@dataclass(frozen=True, kw_only=True)
class PickedFrames:
    """Selects the frames of a run.

    Parameters
    ----------
    every : int
        Only every n-th frame.
    frames : tuple of str
        Only these frames: names of images, positions in the run, and ranges FROM:TO or
        FROM:TO:STEP of positions without the last.
    """

    every: int = 1
    frames: tuple[str, ...] = ()


#: Axes of a robot's poses: X forward and Y left, or the data set's X left and Y backward.
Axes = Literal["robotics", "dataset"]


@dataclass(frozen=True)
class SourceOptions:
    """Options of a source besides its name.

    Parameters
    ----------
    odometry : str
        Where the steps come from, if not from the source itself: a TUM trajectory (.tum; rows t x y
        z qx qy qz qw), counters of two wheels (.ticks; rows t left right), a file of STEP rows, a
        nav_msgs/Odometry topic of the bag (/odom), or none.
    odometry_axes : str
        Axes of the robot in a TUM trajectory: robotics (X forward, Y left) or dataset (X left, Y
        backward).
    wheel_base_m : float
        Distance of the two wheels whose ticks are counted.
    metres_per_tick : float
        Way of a wheel from one tick to the next.
    times : str
        File of the images' times, rows `prefix seconds`; by default <folder>.times among the
        images.
    image_topic : str
        The images of a bag, if there are several topics of them.
    base_frame : str
        The frame of the robot's base, on the floor, in a bag that holds the calibration itself
        (camera_info and tf_static); by default base_footprint.
    frames : int
        Stop after this many frames; 0 for all of them (of a live camera: until Ctrl-C).
    bits : int
        Significant bits of 16-bit images, 8 to 16; 0: the fewest of 8, 10, 12, 14 or 16 that hold
        the values of the first images.
    """

    odometry: str = ""
    odometry_axes: Axes = "robotics"
    wheel_base_m: NotNegative = 0.0
    metres_per_tick: NotNegative = 0.0
    times: str = ""
    image_topic: str = ""
    base_frame: str = ""
    frames: Annotated[int, whole(0)] = 0
    bits: int = 0

    def __post_init__(self) -> None:
        demand_fields(self, DetectError)
        if self.bits and not 8 <= self.bits <= 16:
            raise DetectError(f"bits is {self.bits}: expected 8 to 16, or 0")

    @property
    def plain(self) -> bool:
        """Whether nothing is said of steps and times."""
        return not (self.odometry or self.times or self.image_topic or self.base_frame)


@dataclass(frozen=True, kw_only=True)
class DetectorFlags(RunFlags):
    """Options of all detectors besides their settings.

    Parameters
    ----------
    run : Path
        Run folder of the data set's layout; a folder of images, or a pattern in quotes
        ('drive/*.png'); a video; a ROS 1 or 2 bag or MCAP file; or a camera of this machine,
        camera:0. With a .cam beside it, in the bag, or named by --camera.
    output : Path
        The file to write; by default detected.circles, .lines or .markers in the run folder, or
        named after the video or bag and beside it.
    preset : str
        Values that the other flags start from.
    line_ends : str
        How lines end in files of landmarks; the data set's own end with CR and LF.
    jobs : int
        Processes that share the work, 1 for none beside this one; by default one for every 500
        frames, at most as many as there are cores. What is written is the same.
    cluster : str
        Address of a dask scheduler (tcp://host:8786) whose workers do the work instead.
    strict : bool
        Stop at the first frame that cannot be worked on, with exit code 1 and nothing written.
    resume : bool
        Take over the frames that an unfinished run of the same command kept, and go on after them.
    """

    preset: Preset = "default"
    line_ends: LineEnds = "lf"
    jobs: MaybeInt = None
    cluster: MaybeStr = None
    source: OmitArgPrefixes[SourceOptions] = field(default_factory=SourceOptions)
    strict: bool = False
    resume: bool = False


@dataclass(frozen=True, kw_only=True)
class DiscIdOptions:
    """Where the IDs of discs come from.

    Parameters
    ----------
    ids_from : Path
        A .circles file whose IDs are carried over to the rows of the same discs, levelled or not.
    ids_from_map : Path
        A map (map.csv of `slam map`): rows without an ID by --ids-from get the ID of the disc they
        fall on,
    path : Path
        seen from the frame's pose in this path (path.csv of `slam map`),
    id_slack_m : float
        with this standard deviation of map and path added to the covariances, metres.
    """

    ids_from: MaybePath = None
    ids_from_map: MaybePath = None
    path: MaybePath = None
    id_slack_m: NotNegative = 0.1

    def __post_init__(self) -> None:
        demand_fields(self, DetectError)


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
    tilt : Path
        Tilts of the frames (written by `detect lines`): positions are corrected for them.
    draw : Path
        Folder for images with the outlines and qualities drawn in.
    json : Path
        Write the rows with their pixels and evidence as JSON as well.
    find_radius : bool
        Find the radius of the discs in some of the images first; so says --radius-m auto, too.
    """

    preset: DiscPreset = "default"  # type: ignore[assignment]
    tilt: MaybePath = None
    find_radius: bool = False
    ids: OmitArgPrefixes[DiscIdOptions] = field(default_factory=DiscIdOptions)
    draw: MaybePath = None
    json: MaybePath = None
    settings: OmitArgPrefixes[CircleSettings] = field(default_factory=CircleSettings)


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
    tilt : Path
        The tilt file to write; by default the output's name with the ending .tilt.
    ids_from : Path
        A .lines file whose IDs are carried over where the match is unambiguous.
    join_threshold : float
        Lines whose bearings are closer than this (radians) are joined; overrides `--join-px`.
    draw : Path
        Folder for images with the lines and their standard deviations drawn in.
    rejected : bool
        Draw all tracks instead, the rejected ones with the reason.
    response : bool
        Draw the filter's response as well, into files of their own.
    """

    preset: Literal["default", "published", "report"] = "default"  # type: ignore[assignment]
    tilt: MaybePath = None
    ids_from: MaybePath = None
    join_threshold: MaybeFloat = None
    draw: MaybePath = None
    rejected: bool = False
    response: bool = False
    settings: OmitArgPrefixes[LineSettings] = field(default_factory=LineSettings)


@dataclass(frozen=True, kw_only=True)
class Markers(DetectorFlags):
    """Detect the square markers of a run and write them to a .markers file.

    Example: detect markers images/m/a --dictionary rawseeds, or:
    detect markers camera:0 --frames 100

    Parameters
    ----------
    run : Path
        Run folder of the data set's layout; a folder of images, or a pattern in quotes
        ('drive/*.png'); a video; a ROS 1 or 2 bag or MCAP file; or a camera of this machine,
        camera:0. With a .cam beside it, or named by --camera, the lens's distortion is taken off;
        without one, edges are taken to be straight in the images.
    preset : str
        Values that the other flags start from: `published` is the report's detector.
    draw : Path
        Folder for images with the markers drawn in, and with what was rejected.
    """

    draw: MaybePath = None
    settings: OmitArgPrefixes[MarkerSettings] = field(default_factory=MarkerSettings)


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
    line_ids_from : Path
        A .lines file whose IDs are carried over where the match is unambiguous.
    find_radius : bool
        Find the radius of the discs in some of the images first; so says --circles.radius-m auto,
        too.
    tilt : str
        What levels the discs: `none`, the tilt of the single `frame`, or the `run`'s (a constant
        lean, and the estimated deviation of each frame from it).
    """

    ids: OmitArgPrefixes[DiscIdOptions] = field(default_factory=DiscIdOptions)
    line_ids_from: MaybePath = None
    tilt: Levelling = "run"
    find_radius: bool = False
    circles: CircleSettings = field(default_factory=CircleSettings)
    lines: LineSettings = field(default_factory=LineSettings)
