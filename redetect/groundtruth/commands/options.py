"""The flags of all commands; nothing heavy is imported."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Optional

from tyro.conf import OmitArgPrefixes, Positional, arg

from redetect.groundtruth.markers.settings import NetworkSettings, PoseSettings, RigSettings

# For `X | None` tyro imports another library that takes a tenth of a second.
MaybePath = Optional[Path]  # noqa: UP045
MaybeInt = Optional[int]  # noqa: UP045
MaybeStr = Optional[str]  # noqa: UP045


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
        A boards.json, or its folder.
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
        Relative errors are between poses this many compared poses apart.
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


@dataclass(frozen=True)
class Lasers:
    """Align the fixed laser scanners with each other and with the building.

    Example: groundtruth lasers SESSION -o scanners.json

    Parameters
    ----------
    session : Path
        Folder with scanners.json (poses measured by hand), the scans of the empty area and
        building.csv or building.dxf.
    building : Path
        The building map, if it is not the one in the session.
    gate_m : float
        Farthest that a reading may lie from what it is matched with at first (m).
    keep : float
        Share of the best matches that counts.
    picture : Path
        The picture to write; by default the output's name with the ending .png.
    output : Path
        The scanners file to write; by default aligned.json in the session.
    force : bool
        Replace existing files.
    """

    session: Positional[Path]
    building: MaybePath = None
    gate_m: float = 0.5
    keep: float = 0.95
    picture: MaybePath = None
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    force: bool = False


@dataclass(frozen=True)
class Laser:
    """Track the robot with the fixed laser scanners.

    Example: groundtruth laser SESSION -o laser.csv

    Parameters
    ----------
    session : Path
        Folder with robot.json, the scans, and the scans of the empty area.
    scanners : Path
        Poses of the fixed scanners; by default aligned.json in the session, else scanners.json.
    gate_m : float
        Farthest that a reading may lie from the robot's outline (m).
    keep : float
        Share of the best matches that counts.
    average : int
        Sets of scans that each written pose rests on; no set is used twice.
    output : Path
        Poses to write (t, x, y, theta and 9 of covariance); by default laser.csv in the session.
        An account of every set of scans goes into a .jsonl, settings and version into a .json
        beside it.
    force : bool
        Replace existing files.
    """

    session: Positional[Path]
    scanners: MaybePath = None
    gate_m: float = 0.2
    keep: float = 0.95
    average: int = 6
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    force: bool = False


@dataclass(frozen=True)
class Sync:
    """Align the robot's clock: time offset, drift and angle offset from headings, per segment.

    Example: groundtruth sync odometry.csv laser.csv -o clock.json

    Parameters
    ----------
    odometry : Path
        The robot's own poses (t, x, y, theta) on its clock.
    groundtruth : Path
        Poses (t, x, y, theta, and perhaps 9 of covariance) on the ground truth's clock.
    largest_offset_s : float
        Bound of the time offset, either way (s).
    largest_drift : float
        Bound of the drift: the clocks' rates differ by at most this share.
    segment_gap_s : float
        A longer pause in the ground truth begins a new segment (s).
    use_movement : bool
        Refine the estimate by headings with the whole movement if the ground truth has covariances.
    ptpd : Path
        Log of ptpd, to compare with.
    apply : Path
        Write the odometry on the ground truth's clock to this file.
    output : Path
        The clock file to write.
    force : bool
        Replace existing files.
    """

    odometry: Positional[Path]
    groundtruth: Positional[Path]
    largest_offset_s: float = 1.0
    largest_drift: float = 0.01
    segment_gap_s: float = 5.0
    use_movement: bool = True
    ptpd: MaybePath = None
    apply: MaybePath = None
    output: Annotated[Path, arg(aliases=["-o"])] = Path("clock.json")
    force: bool = False


@dataclass(frozen=True)
class Fuse:
    """Fuse odometry with laser and camera ground truth: filter forward, smooth backward.

    Example: groundtruth fuse odometry.csv --laser laser.csv --camera camera.csv --clock clock.json

    Parameters
    ----------
    odometry : Path
        The robot's own poses (t, x, y, theta).
    laser : Path
        Ground truth from the laser (t, x, y, theta, 9 of covariance).
    camera : Path
        Ground truth from the markers, in the same columns.
    clock : Path
        Output of `groundtruth sync`; without it all clocks are assumed to be one.
    distance_sigma : float
        Standard deviation of odometry's distance per square root of a metre driven (m).
    lateral_sigma : float
        How far the robot slips sideways per square root of a metre driven (m).
    turn_sigma : float
        Standard deviation of odometry's heading per square root of a radian turned (rad).
    turn_per_metre_sigma : float
        The same per square root of a metre driven (rad).
    learn_noise : bool
        Scale these to maximise the likelihood of the measurements.
    gate_probability : float
        Share of right poses that pass the gate.
    covariance_scale : two floats
        Factors on the covariances of laser and camera.
    leave_out : bool
        Leave each segment of the ground truth between two others out as well, predict it, and print
        how far off the prediction is (pauses of more than 5 s begin another segment).
    output : Path
        The file to write (t, x, y, theta and 9 of covariance). What was rejected, settings and
        version go into a .json beside it.
    force : bool
        Replace existing files.
    """

    odometry: Positional[Path]
    laser: MaybePath = None
    camera: MaybePath = None
    clock: MaybePath = None
    distance_sigma: float = 0.02
    lateral_sigma: float = 0.01
    turn_sigma: float = 0.02
    turn_per_metre_sigma: float = 0.01
    learn_noise: bool = True
    gate_probability: float = 0.9999
    covariance_scale: tuple[float, float] = (1.0, 1.0)
    leave_out: bool = False
    output: Annotated[Path, arg(aliases=["-o"])] = Path("fused.csv")
    force: bool = False


@dataclass(frozen=True)
class Validate:
    """Hold a ground truth against reference poses surveyed by distances and on-board scans.

    Example: groundtruth validate SESSION fused.csv -o validation

    Parameters
    ----------
    session : Path
        Folder with fiducials.json, distances.csv, robot.json and the building; with on-board scans,
        they refine the reference poses.
    poses : Path
        The ground truth (t, x, y, theta, and perhaps 9 of covariance).
    clock : Path
        Output of `groundtruth sync`, for the on-board scans.
    refine : str
        `scans`: refine the reference poses by ICP of the on-board scans to the building; `none`:
        distances alone.
    output : Path
        Folder for the table, the reference poses and plots.
    force : bool
        Replace existing files.
    """

    session: Positional[Path]
    poses: Positional[Path]
    clock: MaybePath = None
    refine: Literal["scans", "none"] = "scans"
    output: Annotated[Path, arg(aliases=["-o"])] = Path("validation")
    force: bool = False


@dataclass(frozen=True)
class Report:
    """One page with map, path, covariance ellipses and errors over time, as one HTML file.

    Example: groundtruth report SESSION --truth truth.csv -o report.html

    Parameters
    ----------
    session : Path
        Folder with the building and the results: laser.csv, camera.csv, fused.csv, clock.json and
        validation, as far as they are there.
    truth : Path
        True or reference poses (t, x, y, theta); by default truth.csv in the session, if there.
    output : Path
        The page to write; by default report.html in the session.
    force : bool
        Replace an existing file.
    """

    session: Positional[Path]
    truth: MaybePath = None
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    force: bool = False


Command = Rig | Network | Poses | Score | Lasers | Laser | Sync | Fuse | Validate | Report
