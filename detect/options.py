"""The flags of the detectors and of ``detect compare``: one frozen dataclass per command.

Nothing heavy is imported: `--help` needs it all.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import OmitArgPrefixes, Positional

from detect.comparison.result import CompareOptions
from detect.errors import DetectError
from detect.flags import (
    DiscPreset,
    LineEnds,
    MaybeFloat,
    MaybeInt,
    MaybePath,
    MaybeStr,
    Preset,
    RunFlags,
)
from detect.line_settings import LineSettings
from detect.markers.settings import MarkerSettings
from detect.settings import CircleSettings, Levelling
from detect.sources.options import SourceOptions
from redetect.storage.bounds import NOT_NEGATIVE, demand


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
    id_slack_m: float = 0.1

    def __post_init__(self) -> None:
        demand(self, DetectError, id_slack_m=NOT_NEGATIVE)


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
