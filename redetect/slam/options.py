"""The flags of the command ``slam``: one frozen dataclass per command, nothing heavy imported."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from redetect.bounds import (
    ABOVE_0,
    NOT_NEGATIVE,
    PROBABILITY,
    Bounded,
    MaybeFloat,
    MaybePath,
    MaybeStr,
    Positive,
    whole,
)
from redetect.least_squares import LossKind
from redetect.slam.errors import SlamError
from redetect.slam.models import OdometryNoise
from redetect.slam.settings import (
    DEFAULT_GATE_PROBABILITY,
    AddedNoise,
    AssociateSettings,
    Association,
    Place,
    PlaceSigma,
    RowErrors,
    Solver,
)


@dataclass(frozen=True, kw_only=True)
class RunFlags(Bounded, error=SlamError):
    """Options of all commands that read the landmarks of a run."""

    run: Positional[Path]  # Run folder, or a .circles or .lines file.
    circles: bool = False  # Use the discs; the default if neither kind is given.
    lines: bool = False  # Use the vertical lines.
    # Name of the landmark files in the folder; by default map, else detected.
    stem: MaybeStr = None
    # Calibration, if not the one in the run folder (lines and --calibrate need one).
    camera: MaybePath = None
    force: bool = False  # Replace existing files.
    # Noise of steps without a covariance.
    odometry_noise: OdometryNoise = field(default_factory=OdometryNoise)

    @property
    def runs(self) -> tuple[Path, ...]:
        """All runs that are named."""
        return (self.run,)

    @property
    def rows(self) -> dict[str, Any]:
        """Which rows are read, as `redetect.slam.recording.landmark_files` has it."""
        return {"circles": self.circles or not self.lines, "lines": self.lines, "stem": self.stem}


@dataclass(frozen=True, kw_only=True)
class RunsFlags(RunFlags):
    """Options of commands that take several runs."""

    # Further runs of the same building, each from wherever it started.
    more: Positional[tuple[Path, ...]] = ()

    @property
    def runs(self) -> tuple[Path, ...]:
        """All runs that are named."""
        return (self.run, *self.more)


@dataclass(frozen=True, kw_only=True)
class Map(RunsFlags):
    """Least-squares map: all poses and landmarks of a run, or of several runs, at once.

    Identifiers of several runs have to agree, and the map is in the frame of the first one's start.

    Example: slam map images/e --circles --lines -o /tmp/e-map
    """

    # Also estimate the camera's mounting (rotation, position, height), with discs only.
    calibrate: bool = False
    # With --calibrate, whether its horizontal position is unknown, or only rotation and height.
    place: bool = True
    # With --calibrate, how rows are compared with discs: `recorded`, as they were written, which
    # their covariances refer to; `corrected`, on the floor as the camera as mounted sees it, which
    # biases the camera's height downwards.
    row_errors: RowErrors = "recorded"
    # `separable`: the project's own; `gtsam`: GTSAM's Levenberg-Marquardt does the last steps
    # (extra [slam]), for discs and plain least squares only.
    solver: Solver = "separable"
    # Robust loss: `huber`, `cauchy` or `geman-mcclure` reduces the weight of outliers.
    loss: LossKind = "none"
    loss_scale: Positive = 3.0  # Scale of the robust loss, standard deviations.
    start: Place = (0.0, 0.0, 0.0)  # Pose at the start in the map (m, m, rad).
    # Folder for map.csv, path.csv (of several runs path_1.csv, path_2.csv, ...), table.json and
    # pictures; by default `slam` in the run folder.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    interactive: bool = False  # Also show the pictures in windows.


@dataclass(frozen=True, kw_only=True)
class Audit(RunFlags):
    """Find discs whose identifiers contradict the rest of the run, and write the run without them.

    Example: slam audit images/e -o /tmp/audited.circles
    """

    calibrate: bool = False  # Also estimate the camera's mounting.
    # Squared Mahalanobis distance of a row from which it contradicts the rest.
    gate: Positive = 100.0
    # `mend`: rows get the identifier of the landmark that they show, -1 if none explains them;
    # `drop`: their lines are removed.
    apply: Literal["mend", "drop"] = "mend"
    pictures: MaybePath = None  # Folder for pictures of what the rows show.
    images: MaybePath = None  # Folder of the run's images; by default that of the rows.
    # The landmark file to write; by default audited.circles in the run folder. The rows
    # are listed in a .csv beside it.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None


@dataclass(frozen=True, kw_only=True)
class FilterFlags(RunFlags):
    """Options of both filters."""

    # `known`: rows are associated by their IDs; `nearest` or `joint`: by Mahalanobis distance, of
    # one row at a time or of a frame's rows together.
    association: Association = "known"
    # Share of correct rows that pass the gate; not used with known association.
    gate_probability: Annotated[float, PROBABILITY] = DEFAULT_GATE_PROBABILITY
    start: Place = (0.0, 0.0, 0.0)  # Pose at the start in the map (m, m, rad).
    reference: MaybePath = None  # A path.csv to measure the distance from.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    interactive: bool = False  # Also show the pictures in windows.


@dataclass(frozen=True, kw_only=True)
class Localize(FilterFlags):
    """Localise in a known map with an extended Kalman filter.

    Example: slam localize images/e --map /tmp/e-map/map.csv
    """

    map: Path  # The map (written by `slam map`).
    # Standard deviations of the pose at the start.
    start_sigma: PlaceSigma = (0.0, 0.0, 0.0)
    # The pose at the start is unknown: it is estimated from the discs of the first frames, whatever
    # their identifiers (global localisation). Needs `--association joint` without identifiers.
    lost: bool = False
    # Folder for path.csv, localize.json and pictures; by default `slam/localize` in the run folder.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None

    @property
    def known_start(self) -> Place | None:
        """The pose at the start; None if it is unknown."""
        if not self.lost:
            return self.start
        if any(self.start) or any(self.start_sigma):
            raise SlamError("--lost and --start: expected one of them")
        return None


@dataclass(frozen=True, kw_only=True)
class Ekf(FilterFlags):
    """Map and localise at once with an extended Kalman filter (EKF-SLAM).

    Example: slam ekf images/e --reference /tmp/e-map/path.csv
    """

    reference_map: MaybePath = None  # A map.csv to measure the distance of the landmarks from.
    # Folder for map.csv, path.csv, ekf.json and pictures; by default `slam/ekf` in the run folder.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None


@dataclass(frozen=True, kw_only=True)
class Associate(RunsFlags):
    """Find the rows of a run, or of several, that show the same landmark, and write their IDs.

    IDs in the file are not used, but the result is scored against them.

    Example: slam associate images/e --method joint --map-level
    """

    # Repeat with noise added to the measurements (factors on their standard deviation).
    noise: Annotated[tuple[float, ...], NOT_NEGATIVE] = ()
    seed: Annotated[int, whole(0)] = 1  # Seed of that noise.
    # The landmark file to write; by default associated.circles (or .lines) in the run folder. Both
    # kinds give two files, which differ in the suffix; several runs give found_1.circles,
    # found_2.circles, ... for found.circles. The scores are written to a .json beside.
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    # How a run is associated.
    settings: OmitArgPrefixes[AssociateSettings] = field(default_factory=AssociateSettings)


@dataclass(frozen=True)
class Noise:
    """Add white Gaussian noise to a run, and increase its covariances to match.

    Example: slam noise images/e --sigma 0.05 -o /tmp/noisy.circles
    """

    run: Positional[Path]  # Run folder, or a .circles, .lines or .txt file.
    lines: bool = False  # In a run folder, use the .lines file instead of the .circles.
    # Name of the landmark file in the folder; by default map, else detected.
    stem: MaybeStr = None
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None  # The file to write.
    force: bool = False  # Replace an existing file.
    noise: OmitArgPrefixes[AddedNoise] = field(default_factory=AddedNoise)


@dataclass(frozen=True, kw_only=True)
class Export(RunFlags):
    """Write a run in the formats of other tools, whose axes are X forward, Y left.

    Example: slam export images/e --to g2o -o /tmp/e.g2o
    """

    # Run folder, or a .circles or .lines file; for --to tum also a path.csv.
    run: Positional[Path]
    output: Annotated[Path, arg(aliases=["-o"])]  # The file to write; for csv a folder.
    # `g2o`: graph of poses, discs and their measurements; `tum`: a path as trajectory; `csv`:
    # odometry and measurements as tables for GTSAM or MRPT.
    to: Literal["g2o", "tum", "csv"] = "g2o"
    # For --to tum, times of the frames, rows `prefix seconds`; by default a complete .times file
    # beside the run; without one, t counts the steps.
    times: MaybePath = None


@dataclass(frozen=True)
class Import(Bounded, error=SlamError):
    """Convert files of other tools and data sets to this project's formats.

    Example: slam import /tmp/e.g2o -o /tmp/e-again.circles
    """

    # A .g2o graph, a TUM trajectory, RobotN_Odometry.dat or Landmark_Groundtruth.dat of the UTIAS
    # data set (MRCLAM), or aa3_dr.mat of Victoria Park.
    file: Positional[Path]
    # The file to write: for a graph a .circles file, or, with the suffix .csv, the path of its
    # estimates; for a trajectory a path.csv; for a robot a .circles file, or the .csv of its true
    # path; for true landmarks a map.csv.
    output: Annotated[Path, arg(aliases=["-o"])]
    # Standard deviation of a data set's ranges (m). In the UTIAS data set the noise is learned from
    # the run, unless this or that of bearings is given; then by default 0.03 and 2 %. By default
    # 0.1 in Victoria Park, and without calibration.
    range_sigma: Annotated[MaybeFloat, ABOVE_0] = None
    # Standard deviation of a data set's bearings (rad); by default learned, or 0.02 if that of
    # ranges is given. By default 0.03 in Victoria Park, and without calibration.
    bearing_sigma: Annotated[MaybeFloat, ABOVE_0] = None
    # Correct what the UTIAS data set does not state: ranges are depths, and the robot moves later,
    # faster and farther than its odometry, by as much as the landmarks show. (Victoria Park has no
    # such corrections.)
    calibrated: bool = True
    force: bool = False  # Replace an existing file.
