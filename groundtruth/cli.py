"""The command ``groundtruth``.

Only what `--help` needs is imported at once; everything heavy waits for the command that uses it.

Exit codes: 0 all went well; 1 the command could not be carried out, or gave no pose; 2 the command
line was wrong.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal, Optional

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg, subcommand

from groundtruth.options import Fuse, Laser, Lasers, Report, Sync, Validate
from groundtruth.settings import NetworkSettings, PoseSettings, RigSettings
from storage.messages import one_line

# For `X | None` tyro imports another library that takes a tenth of a second.
MaybePath = Optional[Path]  # noqa: UP045
MaybeInt = Optional[int]  # noqa: UP045
MaybeStr = Optional[str]  # noqa: UP045

EXIT_ERROR = 1


@dataclass(frozen=True)
class Rig:
    """Estimate where the markers sit on the robot, from images that show several of them.

    Example: groundtruth rig calibration/rig/* --width-m 0.2 --robot known.json -o rig.json

    Parameters
    ----------
    runs : one or more Paths
        Run folders with detected.markers and a calibration.
    width_m : float
        Width of the markers' black squares (m).
    widths : str
        Other widths, as `31=0.15`.
    ids : int
        The markers that may be on the robot; by default all that were found.
    dictionary : str
        Their dictionary; by default that of the markers found, if it is one.
    network : Path
        Calibration of the cameras to each other: then images of one time are used together.
    reference : int
        The marker whose frame is the robot's; by default the one seen best.
    robot : Path
        A rig file with the pose of one or more markers in the robot's frame.
    reference_poses : Path
        Known poses (t, x, y, theta) of the robot standing level, which define its frame; needs
        --network.
    output : Path
        The rig file to write.
    picture : Path
        The picture to write; by default the output's name with the ending .png.
    force : bool
        Replace existing files.
    """

    runs: Positional[tuple[Path, ...]]
    width_m: float
    widths: tuple[str, ...] = ()
    ids: tuple[int, ...] = ()
    dictionary: MaybeStr = None
    network: MaybePath = None
    reference: MaybeInt = None
    robot: MaybePath = None
    reference_poses: MaybePath = None
    output: Annotated[Path, arg(aliases=["-o"])] = Path("rig.json")
    picture: MaybePath = None
    force: bool = False
    settings: OmitArgPrefixes[RigSettings] = field(default_factory=RigSettings)


@dataclass(frozen=True)
class Network:
    """Estimate where the cameras are in the world, from images of checkerboards.

    Example: groundtruth network calibration/network -o network.json

    Parameters
    ----------
    boards : Path
        A boards.json, or the folder in which it stands.
    estimate_offset : bool
        Estimate how the double board's halves lie to each other, whatever the file says.
    output : Path
        The network file to write. It names the calibrations relative to its own folder.
    force : bool
        Replace an existing file.
    """

    boards: Positional[Path]
    estimate_offset: bool = False
    output: Annotated[Path, arg(aliases=["-o"])] = Path("network.json")
    force: bool = False
    settings: OmitArgPrefixes[NetworkSettings] = field(default_factory=NetworkSettings)


@dataclass(frozen=True)
class Poses:
    """Work out the robot's poses from the markers found in the images of one or several cameras.

    Example: groundtruth poses SESSION -o poses.csv --report report.jsonl

    Parameters
    ----------
    paths : one or more Paths
        A session (a folder with a run folder per camera), or run folders, whose names are those of
        the network's cameras.
    rig : Path
        Where the markers are on the robot; by default rig.json in the session.
    network : Path
        Where the cameras are in the world; by default network.json in the session.
    output : Path
        The file of poses to write (t, x, y, theta and 9 of covariance); by default poses.csv in
        the session. Settings and version go into a .json beside it.
    tum : Path
        Write the poses in space as a TUM trajectory as well.
    report : Path
        Write an account of every time as lines of JSON.
    force : bool
        Replace existing files.
    """

    paths: Positional[tuple[Path, ...]]
    rig: MaybePath = None
    network: MaybePath = None
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    tum: MaybePath = None
    report: MaybePath = None
    force: bool = False
    settings: OmitArgPrefixes[PoseSettings] = field(default_factory=PoseSettings)


@dataclass(frozen=True)
class Score:
    """Hold poses against the truth: errors, and whether the covariances are right.

    Errors are absolute (ATE) and, with --relations or --rpe-step, relative as well (RPE).

    Example: groundtruth score poses.csv truth.csv

    Parameters
    ----------
    poses : Path
        Poses (t, x, y, theta, and perhaps 9 of covariance).
    truth : Path
        The same of the truth.
    interpolate : str
        Which of the two is interpolated at the other's times.
    largest_gap_s : float
        Nothing is interpolated across longer gaps (s).
    align : bool
        Move the poses rigidly onto the truth first, for solutions with a world of their own.
    relations : Path
        Relations between two times (t_i, t_j, x, y, z, roll, pitch, yaw): the poses are held
        against these too.
    rpe_step : int
        Relative errors from each of the compared poses to the one so many later.
    rpe_longest_s : float
        Such steps that take longer, as across a gap, do not count (s).
    json : Path
        Write the figures as JSON.
    force : bool
        Replace an existing file.
    """

    poses: Positional[Path]
    truth: Positional[Path]
    interpolate: Literal["truth", "poses"] = "truth"
    largest_gap_s: float = 0.5
    align: bool = False
    relations: MaybePath = None
    rpe_step: MaybeInt = None
    rpe_longest_s: float = float("inf")
    json: MaybePath = None
    force: bool = False


Command = Rig | Network | Poses | Score | Lasers | Laser | Sync | Fuse | Validate | Report

#: The module whose `perform` carries a command out.
PERFORMED_BY: dict[type, str] = {
    Rig: "groundtruth.commands",
    Network: "groundtruth.commands",
    Poses: "groundtruth.commands",
    Score: "groundtruth.commands",
    Lasers: "groundtruth.lasers_command",
    Laser: "groundtruth.laser_command",
    Sync: "groundtruth.sync_command",
    Fuse: "groundtruth.fuse_command",
    Validate: "groundtruth.validate_command",
    Report: "groundtruth.report_command",
}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    # Matrices are small here: threads of BLAS would cost more than they save.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    command = tyro.cli(
        Annotated[
            Annotated[Rig, subcommand("rig")]
            | Annotated[Network, subcommand("network")]
            | Annotated[Poses, subcommand("poses")]
            | Annotated[Score, subcommand("score")]
            | Annotated[Lasers, subcommand("lasers")]
            | Annotated[Laser, subcommand("laser")]
            | Annotated[Sync, subcommand("sync")]
            | Annotated[Fuse, subcommand("fuse")]
            | Annotated[Validate, subcommand("validate")]
            | Annotated[Report, subcommand("report")],
            arg(name=""),
        ],
        prog="groundtruth",
        description="Where the robot really was: markers, lasers, clocks, and their fusion.",
        args=sys.argv[1:] if arguments is None else arguments,
    )
    try:
        return int(import_module(PERFORMED_BY[type(command)]).perform(command))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:
        print(f"error: {one_line(str(error))}", file=sys.stderr)
        return EXIT_ERROR
