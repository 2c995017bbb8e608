"""Everything about a simulated run that is decided before its first frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from camera import Camera, parse_camera
from tools.simulator.construction import UprightEdge, make_scene
from tools.simulator.drive import DriveStyle, drive, robot_tilt
from tools.simulator.floor_marks import DISC_RADIUS_M, lay_discs
from tools.simulator.odometry import measured_steps
from tools.simulator.office import build_office
from tools.simulator.office_plan import EXTENT
from tools.simulator.poses import tilted_camera
from tools.simulator.route import is_outside, office_route
from tools.simulator.scene import FloatArray, Scene
from tools.simulator.sensor import Sensor

#: The published calibration of run e of the DLR Spatial Cognition data set.
PUBLISHED_CAMERA = """\
{ SmRadialDistortedCamera
sensor2Tcp: [ 0.99992, -0.00994383, -0.00778315, -0.0820676 ]
[ 0.00718218, -0.0591054, 0.998226, 0.142944 ]
[ -0.0103862, -0.998202, -0.0590291, 0.0522051 ]
sensor2World: [ -0.99992, 0.00994383, 0.00778315, 0.0179777 ]
[ -0.00211987, 0.475426, -0.879753, -0.0808609 ]
[ -0.0124484, -0.879699, -0.475367, 1.50354 ]
mountIndex: 0
width: 768 height: 288 scaleX: 464.762 scaleY: 232.381 offsetX: 384 offsetY: 144
coef: { -0.0620672 -0.324903 0.314764 1.52524 -0.480806 }
}
"""

_SUN = (0.30, -0.70, 0.50, 3.0)
_SKY = 3.0


@dataclass(frozen=True)
class RunSettings:
    """What a simulated run is to be like."""

    name: str = "sim"
    frames: int = 3297
    seed: int = 1
    discs: int = 576
    lookalikes: int = 140
    visits: float = 0.6
    """Probability that a room with an open door is visited in passing."""
    skip: int = 0
    """Steps of the drive that go by before the first frame."""
    unlabelled: float = 0.03
    """Share of rows whose ID is not known (-1)."""
    camera_text: str = PUBLISHED_CAMERA
    """Text of the calibration (.cam) through which the run is seen."""
    style: DriveStyle = field(default_factory=DriveStyle)
    sensor: Sensor = field(default_factory=Sensor)


@dataclass(frozen=True)
class RunPlan:
    """A run that needs only be rendered."""

    settings: RunSettings
    camera: Camera
    scene: Scene
    edges: list[UprightEdge]
    pictures: list[tuple[float, float, float, float, float, float]]
    disc_ids: NDArray[np.int64]
    disc_xy: FloatArray
    disc_radius_m: float
    lookalikes: list[tuple[str, float, float]]
    poses: FloatArray
    """(frames + 1, 3) true poses: before the first step and after each."""
    tilts_rad: FloatArray
    """(frames, 2) tilt (p, q) at each frame."""
    steps: FloatArray
    """(frames, 3) odometry."""
    wrong_odometry: NDArray[np.bool_]
    """(frames,) whether the odometry of the step is beyond its covariance."""
    unlabelled: NDArray[np.bool_]
    """(frames, discs) whether a row would not know the disc's ID."""

    def true_camera(self, frame: int) -> Camera:
        """The camera as it is mounted at a frame, tilt included."""
        return tilted_camera(self.camera, self.tilts_rad[frame])

    def prefix(self, frame: int) -> str:
        """Name of a frame's image, without extension."""
        return f"{self.settings.name}.{frame:04d}"


Purpose = Literal["building", "route", "drive", "marks", "tilt", "odometry", "labels", "rows"]
_PURPOSES: tuple[Purpose, ...] = (
    "building", "route", "drive", "marks", "tilt", "odometry", "labels", "rows",
)  # fmt: skip


def random_for(seed: int, purpose: Purpose) -> np.random.Generator:
    """A stream of random numbers of its own for each purpose: changing one leaves the others."""
    return np.random.default_rng(np.random.SeedSequence([seed, _PURPOSES.index(purpose)]))


def random_for_frame(seed: int, frame: int) -> np.random.Generator:
    """The random numbers of one frame, whatever was rendered before it."""
    return np.random.default_rng(np.random.SeedSequence([seed, len(_PURPOSES), frame]))


def plan_run(settings: RunSettings, *, lit: bool = True) -> RunPlan:
    """Build the office, lay the discs and drive through it.

    Parameters
    ----------
    settings : RunSettings
        Length, seed and looks of the run.
    lit : bool
        Whether the light is worked out; not needed where nothing is rendered.

    Returns
    -------
    RunPlan

    Raises
    ------
    ValueError
        If the route is shorter than the run, or there is no room for so many discs.
    """
    seed, frames = settings.seed, settings.frames
    camera = parse_camera(settings.camera_text, "the calibration")
    office = build_office(random_for(seed, "building"))
    corners = office_route(office, random_for(seed, "route"), settings.visits)
    driven = drive(corners, settings.skip + frames, settings.style, random_for(seed, "drive"))
    poses = driven[settings.skip :]
    lay_discs(
        office.building, poses, settings.discs, settings.lookalikes, random_for(seed, "marks"),
        EXTENT,
    )  # fmt: skip
    scene = make_scene(
        office.building, EXTENT, office.floor_kind, office.floorings, office.indoors, _SUN, _SKY,
        lit=lit,
    )  # fmt: skip
    discs = [m for m in office.building.marks if m.disc_id >= 0]
    wrong = is_outside(poses[1:]) | is_outside(poses[:-1])
    chance = random_for(seed, "labels").random((frames, len(discs)))
    return RunPlan(
        settings=settings,
        camera=camera,
        scene=scene,
        edges=office.building.distinct_edges(),
        pictures=office.building.pictures,
        disc_ids=np.array([m.disc_id for m in discs], dtype=np.int64),
        disc_xy=np.array([[m.x, m.y] for m in discs]).reshape(-1, 2),
        disc_radius_m=DISC_RADIUS_M,
        lookalikes=[(m.label, m.x, m.y) for m in office.building.marks if m.disc_id < 0],
        poses=poses,
        tilts_rad=robot_tilt(frames, settings.style, random_for(seed, "tilt")),
        steps=measured_steps(poses, random_for(seed, "odometry"), wrong),
        wrong_odometry=wrong,
        unlabelled=chance < settings.unlabelled,
    )
