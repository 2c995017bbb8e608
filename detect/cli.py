"""The command ``detect``.

Only what `--help` needs is imported at once; everything heavy waits for the command that uses it.

Exit codes: 0 all went well; 1 the command could not be carried out, or a demand of `compare` or
`--strict` was not met; 2 the command line was wrong; 3 some frames could not be worked on (the
others were); 130 it was interrupted, and wrote nothing but what `--resume` goes on with.
"""

from __future__ import annotations

import atexit
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Optional

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg, subcommand

from detect.compare_result import CompareOptions
from detect.conduct import ConductOptions
from detect.errors import WorkerError
from detect.exports.options import Export
from detect.interrupts import interrupts_noted
from detect.line_settings import PRESETS as LINE_PRESETS
from detect.line_settings import LineSettings
from detect.markers.settings import PRESETS as MARKER_PRESETS
from detect.markers.settings import MarkerSettings
from detect.settings import PUBLISHED, CircleSettings
from detect.sources.options import SourceOptions
from detect.viewing_options import Draw, Report, Tune, View
from storage.messages import one_line

Preset = Literal["default", "published"]

# For `X | None` tyro imports another library that takes a tenth of a second.
MaybePath = Optional[Path]  # noqa: UP045
MaybeInt = Optional[int]  # noqa: UP045
MaybeFloat = Optional[float]  # noqa: UP045
MaybeStr = Optional[str]  # noqa: UP045

EXIT_ERROR = 1
EXIT_FRAMES_FAILED = 3
EXIT_INTERRUPTED = 130

# Numba's words where neither the program's folder nor the user's cache can be written to.
_NO_KERNEL_CACHE = "no locator available"
_WHERE_KERNELS_GO = (
    "compiled kernels cannot be kept, neither beside the program nor in the user's cache folder: "
    "name a folder for them by the environment variable NUMBA_CACHE_DIR"
)

_CIRCLE_PRESETS = {"default": CircleSettings(), "published": PUBLISHED}


@dataclass(frozen=True)
class Circles:
    """Detect the discs of a run and write them to a .circles file.

    Example: detect circles images/e --draw /tmp/discs, or:
    detect circles drive.mcap --camera front.cam --odometry /odom

    Parameters
    ----------
    run : Path
        Run folder of the data set's layout; a folder of images, or a pattern in quotes
        ('drive/*.png'); a video; a ROS 1 or 2 bag or MCAP file; or a camera of this machine,
        camera:0. With a .cam beside it, in the bag, or named by --camera.
    preset : str
        Values that the other flags start from: `published` is the report's detector to the letter.
    camera : Path
        Calibration, if it is not the one in the run folder.
    output : Path
        The file to write; by default detected.circles in the run folder, or named after the video
        or bag and beside it.
    tilt : Path
        Tilts of the frames (written by `detect lines`): positions are corrected for them.
    force : bool
        Replace existing files.
    draw : Path
        Folder for images with the outlines and qualities drawn in.
    json : Path
        Write the rows with their pixels and evidence as JSON as well.
    jobs : int
        Processes that share the work, 1 for none beside this one; by default one for every 500
        frames, at most as many as there are cores. What is written is the same.
    cluster : str
        Address of a dask scheduler (tcp://host:8786) whose workers do the work instead.
    """

    run: Positional[Path]
    preset: Preset = "default"
    camera: MaybePath = None
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    tilt: MaybePath = None
    force: bool = False
    draw: MaybePath = None
    json: MaybePath = None
    jobs: MaybeInt = None
    cluster: MaybeStr = None
    source: OmitArgPrefixes[SourceOptions] = field(default_factory=SourceOptions)
    conduct: OmitArgPrefixes[ConductOptions] = field(default_factory=ConductOptions)
    settings: OmitArgPrefixes[CircleSettings] = field(default_factory=CircleSettings)


@dataclass(frozen=True)
class Lines:
    """Detect the verticals of a run and write them to a .lines file, and the tilt to a .tilt file.

    Example: detect lines images/e --join-threshold 0.006, or:
    detect lines drive.avi --camera front.cam --frames 100

    Parameters
    ----------
    run : Path
        Run folder of the data set's layout; a folder of images, or a pattern in quotes
        ('drive/*.png'); a video; a ROS 1 or 2 bag or MCAP file; or a camera of this machine,
        camera:0. With a .cam beside it, in the bag, or named by --camera.
    preset : str
        Values that the other flags start from: `published` is the report's parameters.
    camera : Path
        Calibration, if it is not the one in the run folder.
    output : Path
        The file to write; by default detected.lines in the run folder, or named after the video
        or bag and beside it.
    tilt : Path
        The tilt file to write; by default the output's name with the ending .tilt.
    ids_from : Path
        A .lines file whose IDs are carried over where the match is unambiguous.
    join_threshold : float
        Lines whose bearings are closer than this (radians) are joined; overrides `--join-px`.
    force : bool
        Replace existing files.
    draw : Path
        Folder for images with the lines and their standard deviations drawn in.
    rejected : bool
        Draw all tracks instead, the rejected ones with the reason.
    response : bool
        Draw the filter's response as well, into files of their own.
    jobs : int
        Processes that share the work, 1 for none beside this one; by default one for every 500
        frames, at most as many as there are cores. What is written is the same.
    cluster : str
        Address of a dask scheduler (tcp://host:8786) whose workers do the work instead.
    """

    run: Positional[Path]
    preset: Preset = "default"
    camera: MaybePath = None
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    tilt: MaybePath = None
    ids_from: MaybePath = None
    join_threshold: MaybeFloat = None
    force: bool = False
    draw: MaybePath = None
    rejected: bool = False
    response: bool = False
    jobs: MaybeInt = None
    cluster: MaybeStr = None
    source: OmitArgPrefixes[SourceOptions] = field(default_factory=SourceOptions)
    conduct: OmitArgPrefixes[ConductOptions] = field(default_factory=ConductOptions)
    settings: OmitArgPrefixes[LineSettings] = field(default_factory=LineSettings)


@dataclass(frozen=True)
class Markers:
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
    camera : Path
        Calibration, if it is not the one in the run folder.
    output : Path
        The file to write; by default detected.markers in the run folder, or named after the video
        or bag and beside it.
    force : bool
        Replace existing files.
    draw : Path
        Folder for images with the markers drawn in, and with what was rejected.
    jobs : int
        Processes that share the work, 1 for none beside this one; by default one for every 500
        frames, at most as many as there are cores. What is written is the same.
    cluster : str
        Address of a dask scheduler (tcp://host:8786) whose workers do the work instead.
    """

    run: Positional[Path]
    preset: Preset = "default"
    camera: MaybePath = None
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    force: bool = False
    draw: MaybePath = None
    jobs: MaybeInt = None
    cluster: MaybeStr = None
    source: OmitArgPrefixes[SourceOptions] = field(default_factory=SourceOptions)
    conduct: OmitArgPrefixes[ConductOptions] = field(default_factory=ConductOptions)
    settings: OmitArgPrefixes[MarkerSettings] = field(default_factory=MarkerSettings)


@dataclass(frozen=True)
class All:
    """Detect verticals, tilt and discs of a run; the discs' positions are corrected for the tilt.

    Example: detect all images/e --circles.polarity light, or:
    detect all 'drive/*.png' --camera front.cam --times drive.times --odometry drive.tum

    Parameters
    ----------
    run : Path
        Run folder of the data set's layout; a folder of images, or a pattern in quotes
        ('drive/*.png'); a video; a ROS 1 or 2 bag or MCAP file; or a camera of this machine,
        camera:0. With a .cam beside it, in the bag, or named by --camera.
    preset : str
        Values that the other flags start from.
    camera : Path
        Calibration, if it is not the one in the run folder.
    output : Path
        Folder for detected.circles, detected.lines and detected.tilt; by default the run's, or
        named after the video or bag and beside it.
    force : bool
        Replace existing files.
    jobs : int
        Processes that share the work, 1 for none beside this one; by default one for every 500
        frames, at most as many as there are cores. What is written is the same.
    cluster : str
        Address of a dask scheduler (tcp://host:8786) whose workers do the work instead.
    """

    run: Positional[Path]
    preset: Preset = "default"
    camera: MaybePath = None
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    force: bool = False
    jobs: MaybeInt = None
    cluster: MaybeStr = None
    source: OmitArgPrefixes[SourceOptions] = field(default_factory=SourceOptions)
    conduct: OmitArgPrefixes[ConductOptions] = field(default_factory=ConductOptions)
    circles: CircleSettings = field(default_factory=CircleSettings)
    lines: LineSettings = field(default_factory=LineSettings)


@dataclass(frozen=True)
class Compare:
    """Compare detected rows with reference rows: matched, missed, extra, errors.

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
    tolerance_deg : float
        Bearings of the same line differ by at most this,
    sigmas : float
        or by this many standard deviations of the detected one.
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
    tolerance_deg: float = 0.5
    sigmas: float = 2.0
    min_recall: MaybeFloat = None
    min_precision: MaybeFloat = None
    json: MaybePath = None
    force: bool = False
    options: OmitArgPrefixes[CompareOptions] = field(default_factory=CompareOptions)


Command = Circles | Lines | Markers | All | Compare | Export | Draw | View | Report | Tune


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    with interrupts_noted() as interrupted:
        try:
            command = _parsed(sys.argv[1:] if arguments is None else arguments)
            from detect.commands import carry_out

            return carry_out(command)
        except KeyboardInterrupt:
            pass
        except (ValueError, OSError, WorkerError) as error:
            if not interrupted.is_set():
                print(f"error: {one_line(str(error))}", file=sys.stderr)
                return EXIT_ERROR
        except BaseException as error:
            if not interrupted.is_set():
                if _NO_KERNEL_CACHE in str(error):
                    print(f"error: {_WHERE_KERNELS_GO}", file=sys.stderr)
                    return EXIT_ERROR
                raise
    print("interrupted", file=sys.stderr, flush=True)
    if arguments is None:
        # Left to itself, Python dies of an interrupt that passed through an `exec` of some
        # library's, although it was caught here.
        atexit._run_exitfuncs()
        os._exit(EXIT_INTERRUPTED)
    return EXIT_INTERRUPTED


def _parsed(given: list[str]) -> Command:
    preset = _preset(given)
    circles = _CIRCLE_PRESETS.get(preset, CircleSettings())
    lines = LINE_PRESETS.get(preset, LineSettings())
    markers = MARKER_PRESETS.get(preset, MarkerSettings())
    return tyro.cli(
        Annotated[
            Annotated[
                Circles,
                subcommand("circles", default=Circles(run=tyro.MISSING, settings=circles)),
            ]
            | Annotated[
                Lines,
                subcommand("lines", default=Lines(run=tyro.MISSING, settings=lines)),
            ]
            | Annotated[
                Markers,
                subcommand("markers", default=Markers(run=tyro.MISSING, settings=markers)),
            ]
            | Annotated[
                All,
                subcommand("all", default=All(run=tyro.MISSING, circles=circles, lines=lines)),
            ]
            | Annotated[Compare, subcommand("compare")]
            | Annotated[Export, subcommand("export")]
            | Annotated[Draw, subcommand("draw")]
            | Annotated[View, subcommand("view")]
            | Annotated[Report, subcommand("report")]
            | Annotated[Tune, subcommand("tune")],
            arg(name=""),
        ],
        prog="detect",
        description="Landmarks with covariances out of a calibrated camera's images.",
        args=given,
    )


def _preset(arguments: list[str]) -> str:
    """The preset that a command line names: it decides the other flags' defaults."""
    for position, argument in enumerate(arguments):
        if argument == "--preset" and position + 1 < len(arguments):
            return arguments[position + 1]
        if argument.startswith("--preset="):
            return argument.partition("=")[2]
    return "default"
