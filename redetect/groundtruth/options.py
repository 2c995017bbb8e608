"""The flags of all commands; nothing heavy is imported."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from redetect.bounds import Bounded, Limit, LimitOr0, MaybeInt, MaybePath, whole
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.settings import (
    AlignmentSettings,
    FuseSettings,
    LaserSettings,
    NetworkSettings,
    PoseSettings,
    RigSettings,
    SyncSettings,
)


@dataclass(frozen=True)
class Rig:
    """Estimate the poses of the markers on the robot, from images that show several of them.

    Example: groundtruth rig calibration/rig/*/ --width-m 0.2 --robot known.json -o rig.json
    """

    runs: Positional[tuple[Path, ...]]  # Run folders with detected.markers and a calibration.
    width_m: float  # Width of the markers' black squares (m).
    # Network file with the cameras' relative poses: images taken at one time are used together.
    network: MaybePath = None
    # The marker whose frame is the robot's; by default the one seen best.
    reference: MaybeInt = None
    robot: MaybePath = None  # A rig file with the pose of one or more markers in the robot's frame.
    # The rig file to write, and a picture beside it (.png).
    output: Annotated[Path, arg(aliases=["-o"])] = Path("rig.json")
    force: bool = False  # Replace existing files.
    settings: OmitArgPrefixes[RigSettings] = field(default_factory=RigSettings)


@dataclass(frozen=True)
class Network:
    """Estimate the poses of the cameras in the world, from images of checkerboards.

    Example: groundtruth network calibration/network -o network.json
    """

    boards: Positional[Path]  # A boards.json, or its folder.
    # The network file to write; its paths of calibrations are relative to its folder.
    output: Annotated[Path, arg(aliases=["-o"])] = Path("network.json")
    force: bool = False  # Replace an existing file.
    settings: OmitArgPrefixes[NetworkSettings] = field(default_factory=NetworkSettings)


@dataclass(frozen=True)
class Poses:
    """Compute the robot's poses from the markers found in the images of one or several cameras.

    Example: groundtruth poses SESSION -o poses.csv --report report.jsonl
    """

    # A folder with a run folder per camera, named as the cameras in the network.
    session: Positional[Path]
    rig: MaybePath = None  # Markers' poses on the robot; by default rig.json in the session.
    # Cameras' poses in the world; by default network.json in the session.
    network: MaybePath = None
    # The file of poses to write (t, x, y, theta and 9 of covariance); by default poses.csv in the
    # session. Settings and version are written to a .json beside it.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    tum: MaybePath = None  # Also write the poses in space as a TUM trajectory.
    report: MaybePath = None  # Write a report on every time as lines of JSON.
    force: bool = False  # Replace existing files.
    settings: OmitArgPrefixes[PoseSettings] = field(default_factory=PoseSettings)


@dataclass(frozen=True)
class Score(Bounded, error=GroundTruthError):
    """Compare poses with the truth: errors, and consistency of the covariances.

    Errors are absolute (ATE) and, with --relations or --rpe-step, also relative (RPE).

    Example: groundtruth score poses.csv truth.csv
    """

    poses: Positional[Path]  # Poses (t, x, y, theta, and perhaps 9 of covariance).
    truth: Positional[Path]  # The same for the truth.
    # Which of the two is interpolated at the other's times.
    interpolate: Literal["truth", "poses"] = "truth"
    largest_gap_s: LimitOr0 = 0.5  # Nothing is interpolated across longer gaps (s).
    # Align the poses rigidly with the truth first, for solutions with a world of their own.
    align: bool = False
    # Relations between two times (t_i, t_j, x, y, z, roll, pitch, yaw): the poses are also compared
    # with these.
    relations: MaybePath = None
    # Number of compared poses between the poses of a relative error.
    rpe_step: Annotated[MaybeInt, whole(1)] = None
    # Steps that take longer than this, as across a gap, are ignored (s).
    rpe_longest_s: Limit = inf
    json: MaybePath = None  # Write the figures as JSON; -: to standard output only.
    force: bool = False  # Replace an existing file.

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rpe_step is None and self.rpe_longest_s < inf:
            raise GroundTruthError("rpe_longest_s is of no use: expected --rpe-step as well")


@dataclass(frozen=True)
class Lasers:
    """Align the fixed laser scanners with each other and with the building.

    Example: groundtruth lasers SESSION
    """

    # Folder with scanners.json (poses measured by hand), the scans of the empty area and
    # building.csv or building.dxf.
    session: Positional[Path]
    # The scanners file to write, and a picture beside it (.png); by default aligned.json in the
    # session.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    force: bool = False  # Replace existing files.
    settings: OmitArgPrefixes[AlignmentSettings] = field(default_factory=AlignmentSettings)


@dataclass(frozen=True)
class Laser(Bounded, error=GroundTruthError):
    """Track the robot with the fixed laser scanners.

    Example: groundtruth laser SESSION -o laser.csv
    """

    session: Positional[Path]  # Folder with robot.json, the scans, and the scans of the empty area.
    # Poses of the fixed scanners; by default aligned.json in the session, else scanners.json.
    scanners: MaybePath = None
    # Number of sets of scans per written pose, none of which is used twice; by default those of
    # 0.08 s.
    average: Annotated[MaybeInt, whole(1)] = None
    # Poses to write (t, x, y, theta and 9 of covariance); by default laser.csv in the session. A
    # report on every set of scans is written to a .jsonl, settings and version to a .json beside.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    force: bool = False  # Replace existing files.
    settings: OmitArgPrefixes[LaserSettings] = field(default_factory=LaserSettings)


@dataclass(frozen=True)
class Sync:
    """Align the robot's clock: time offset, drift and angle offset from headings, per segment.

    Example: groundtruth sync odometry.csv laser.csv -o clock.json
    """

    odometry: Positional[Path]  # The robot's own poses (t, x, y, theta) on its clock.
    # Poses (t, x, y, theta, and perhaps 9 of covariance) on the ground truth's clock.
    groundtruth: Positional[Path]
    ptpd: MaybePath = None  # Log of ptpd, to compare with.
    output: Annotated[Path, arg(aliases=["-o"])] = Path("clock.json")  # The clock file to write.
    force: bool = False  # Replace existing files.
    settings: OmitArgPrefixes[SyncSettings] = field(default_factory=SyncSettings)


@dataclass(frozen=True)
class Fuse:
    """Fuse odometry with laser and camera ground truth: filter forward, smooth backward.

    Example: groundtruth fuse odometry.csv --laser laser.csv --camera camera.csv --clock clock.json
    """

    odometry: Positional[Path]  # The robot's own poses (t, x, y, theta).
    laser: MaybePath = None  # Ground truth from the laser (t, x, y, theta, 9 of covariance).
    camera: MaybePath = None  # Ground truth from the markers, in the same columns.
    # Output of `groundtruth sync`; without it, all clocks are assumed to be the same.
    clock: MaybePath = None
    # Also cross-validate: leave out each segment of the ground truth between two others, predict
    # it, and print the errors (pauses of more than 5 s begin another segment).
    leave_out: bool = False
    # Also write the poses of the forward filter alone, from measurements until then, to this file.
    filtered: MaybePath = None
    # The file to write (t, x, y, theta and 9 of covariance). Rejected measurements, settings and
    # version are written to a .json beside it.
    output: Annotated[Path, arg(aliases=["-o"])] = Path("fused.csv")
    force: bool = False  # Replace existing files.
    settings: OmitArgPrefixes[FuseSettings] = field(default_factory=FuseSettings)


@dataclass(frozen=True)
class Validate:
    """Compare a ground truth with reference poses surveyed by distances and on-board scans.

    Example: groundtruth validate SESSION fused.csv -o validation
    """

    # Folder with fiducials.json, distances.csv, robot.json and the building; on-board scans in it
    # refine the reference poses.
    session: Positional[Path]
    poses: Positional[Path]  # The ground truth (t, x, y, theta, and perhaps 9 of covariance).
    clock: MaybePath = None  # Output of `groundtruth sync`, for the on-board scans.
    # `scans`: refine the reference poses by ICP of the on-board scans to the building; `none`:
    # distances alone.
    refine: Literal["scans", "none"] = "scans"
    # Folder for the table, the reference poses and plots.
    output: Annotated[Path, arg(aliases=["-o"])] = Path("validation")
    force: bool = False  # Replace existing files.


@dataclass(frozen=True)
class Report:
    """Write an HTML page with map, path, covariance ellipses and errors over time.

    Example: groundtruth report SESSION --truth truth.csv -o report.html
    """

    # Folder with the building and those of the results laser.csv, camera.csv or poses.csv,
    # fused.csv, clock.json and validation that exist.
    session: Positional[Path]
    # True or reference poses (t, x, y, theta); by default truth.csv in the session, if it exists.
    truth: MaybePath = None
    # The page to write; by default report.html in the session.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    force: bool = False  # Replace an existing file.
