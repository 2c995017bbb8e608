"""Settings of a simulated laser session."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from redetect.bounds import Bounded, Bounds, NotNegative, Positive, Share, whole
from redetect.groundtruth.errors import GroundTruthError

FIXED_SCANNERS = 4
_NAMES = ("", *(f"fixed{i}" for i in range(FIXED_SCANNERS)))
_NAME = Bounds("fixed0 to fixed3", _NAMES.__contains__)
_RANGE = Bounds("above 0, at most 65", lambda x: 0.0 < x <= 65.0)


@dataclass(frozen=True)
class ReadingErrors(Bounded, error=GroundTruthError):
    """Errors of readings."""

    sigma_m: NotNegative = 0.01  # Standard deviation (m).
    quantum_m: Positive = 0.01
    """Readings are whole multiples of this (m), before they are stored in millimetres."""
    dropouts: Share = 0.005  # Share of readings that are lost.
    lost_scans: Share = 0.002  # Share of scans that are lost.
    mixed: Share = 0.15
    """Share of readings beside an edge that lie between the near and the far side."""
    sweep_s: NotNegative = 0.0
    """From a scan's first beam to its last; 0: all beams at once. A SICK at 75 Hz takes 0.00667."""


@dataclass(frozen=True)
class WheelErrors(Bounded, error=GroundTruthError):
    """Errors of odometry."""

    scale: Positive = 1.008  # Measured way per way.
    turn_scale: Positive = 1.01  # Measured turn per turn.
    turn_per_m: float = 0.002  # Turn that is measured per metre straight on (rad).
    sigma_m: NotNegative = 0.006  # Random error of the way per square root of a metre (m).
    sigma_turn: NotNegative = 0.008
    """Random error of the heading per square root of a radian turned (rad)."""
    sigma_turn_per_m: NotNegative = 0.004
    """Random error of the heading per square root of a metre (rad)."""
    sigma_side_m: NotNegative = 0.0  # Sideways slip per square root of a metre (m).


@dataclass(frozen=True)
class DrivingLimits(Bounded, error=GroundTruthError):
    """Limits of the robot's motion."""

    speed_m_s: Positive = 0.8  # Straight on (m/s).
    turn_rad_s: Positive = 0.8  # In turns (rad/s).
    acceleration_m_s2: Positive = 0.5  # Straight on (m/s^2).


@dataclass(frozen=True)
class Faults(Bounded, error=GroundTruthError):
    """Deliberate faults; times count from when the robot first enters the room."""

    wrong_scanner: Annotated[str, _NAME] = ""
    """This fixed scanner's pose measured by hand is wrong, far beyond its sigma."""
    moved_scanner: Annotated[str, _NAME] = ""
    """This fixed scanner was knocked after the empty area was scanned."""
    by: tuple[float, float, float] = (0.4, -0.3, 0.15)
    """How far the scanner is wrong or was knocked: x, y (m), theta (rad)."""
    clock_jump_s: NotNegative = 0.0
    """The robot's clock is set forward by this. Set back, it would repeat stamps."""
    clock_jump_at_s: NotNegative = 30.0  # When that happens.
    lost_camera_at_s: NotNegative = 20.0  # From this time on the cameras give nothing.
    lost_camera_s: NotNegative = 0.0  # For how long.
    lost_laser_at_s: NotNegative = 20.0  # From this time on all fixed scanners give nothing.
    lost_laser_s: NotNegative = 0.0  # For how long.
    crossing: bool = False  # Somebody passes right beside the robot in the middle of every visit.


@dataclass(frozen=True)
class LaserSettings(Bounded, error=GroundTruthError):
    """All settings of a session except its seed."""

    visits: Annotated[int, whole(1)] = 3  # Visits to the covered room.
    visit_s: Positive = 60.0  # About how long each of them lasts.
    between_s: NotNegative = 120.0  # About how long the robot is away between them.
    straight: bool = False  # The robot goes straight through the room, without turns.
    references: Annotated[int, whole(0)] = 23
    """Poses at which it stands and distances to fiducials are measured."""
    stand_s: Positive = 1.5  # How long it stands there.
    passers: Annotated[int, whole(0)] = 2  # Passers-by in each visit.
    furniture: bool = True  # Things that stand there without being in the map.
    front_cut_m: NotNegative = 0.12
    """The robot's front corners are cut by this; 0 makes it a rectangle, which looks the same
    turned round."""
    rate_hz: Positive = 75.0  # Of the fixed scanners.
    onboard_hz: Positive = 75.0  # Of the scanners on board.
    max_range_m: Annotated[float, _RANGE] = 16.0  # Of all scanners.
    empty_s: Positive = 4.0  # How long the empty room is scanned.
    odometry_hz: Positive = 50.0  # Of the odometry.
    pause_log: bool = False  # The robot's log pauses between the visits.
    camera_hz: Positive = 5.0  # Of the poses from markers.
    camera_misses: Share = 0.1  # Share of times at which the cameras see nothing.
    truth_hz: Positive = 100.0  # Of the exact poses.
    ptpd_hz: Positive = 0.5  # Of ptpd's reports.
    clock_offset_s: float = 0.18  # Robot's clock minus ground truth's at the beginning.
    clock_drift: float = 4e-5  # The robot's clock goes faster by this share.
    hand_sigma_m: NotNegative = 0.05  # Of the fixed scanners' positions measured by hand.
    hand_sigma_deg: NotNegative = 2.0  # Of their directions.
    distance_sigma_m: NotNegative = 0.005
    """Of the distances to the fiducials, and all others by tape."""
    drawing_sigma_m: NotNegative = 0.0
    """Of the walls' ends in the drawing, as against the building."""
    mount_sigma_m: NotNegative = 0.0  # Of the places of the scanners on board, as measured by hand.
    mount_sigma_deg: NotNegative = 0.0  # Of their directions.
    reading: ReadingErrors = field(default_factory=ReadingErrors)
    wheels: WheelErrors = field(default_factory=WheelErrors)
    driving: DrivingLimits = field(default_factory=DrivingLimits)
    faults: Faults = field(default_factory=Faults)
