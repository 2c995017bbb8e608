"""A session in a room: where the robot stands and drives, what each camera sees of it, and when."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from redetect.groundtruth.geometry.transforms import apply, inverse, planar_transform
from redetect.groundtruth.markers.calibration import Network, Rig
from tools.simulator.markers.clutter import Grey
from tools.simulator.markers.imaging import Imaging, grey_image, uneven_light
from tools.simulator.markers.prints import BLACK, WHITE
from tools.simulator.markers.rendering import SurfaceArrays, render_light
from tools.simulator.markers.robot import FOOTPRINT_M, robot_rig, robot_surfaces
from tools.simulator.markers.room import (
    CAMERA_NAMES,
    lit,
    obstacles,
    room_cameras,
    room_surfaces,
)
from tools.simulator.markers.surface import FloatArray, Surface
from tools.simulator.markers.truth import (
    MarkerTruth,
    marker_corners,
    mean_side_px,
    slant_deg,
    visible_shares,
)

_FIRST_S = 1000.0
_STANDING_S = 2.0
_MOST_EXPOSURES = 4
_SHADOW = 0.45


@dataclass(frozen=True)
class SessionSettings:
    """What a session is to be like."""

    name: str = "session"
    """Its name; those of the images begin with it."""
    seed: int = 1
    """Everything about it follows from this."""
    cameras: int = 4
    """Cameras in the corners of the room, 1 to 4."""
    area_m: tuple[float, float] = (6.0, 4.5)
    """Extent of the area in which the robot drives (m)."""
    width: int = 1280
    """Of the images (pixels)."""
    height: int = 960
    """Of the images (pixels)."""
    references: int = 23
    """Poses at which the robot stands still, before the drive."""
    steps: int = 300
    """Images of the drive per camera."""
    rate_hz: float = 5.0
    """Images per second of the drive."""
    speed_m_s: float = 0.35
    """Mean speed of the drive (m/s)."""
    exposure_s: float = 0.012
    """How long the shutter is open (s)."""
    dictionary: str = "rawseeds"
    """Set of the robot's markers."""
    marker_m: float = 0.2
    """Width of the black squares (m)."""
    blur_px: float = 0.8
    """Standard deviation of the optics' blur (pixels)."""
    noise_grey: float = 2.0
    """Standard deviation of the noise (grey levels)."""
    samples: int = 16
    """Rays in each quarter of a pixel that an edge crosses."""


Purpose = Literal["rig", "cameras", "room", "robot", "drive", "errors", "light", "boards", "frame"]
_PURPOSES: tuple[Purpose, ...] = (
    "rig", "cameras", "room", "robot", "drive", "errors", "light", "boards", "frame",
)  # fmt: skip


def random_for(seed: int, purpose: Purpose, *which: int) -> np.random.Generator:
    """A stream of random numbers of its own for each purpose: changing one leaves the others."""
    return np.random.default_rng(np.random.SeedSequence([seed, _PURPOSES.index(purpose), *which]))


@dataclass(frozen=True, eq=False)
class SessionPlan:
    """A session that needs only be rendered, everything exactly true.

    Attributes
    ----------
    settings : SessionSettings
    rig : Rig
        The robot's markers.
    network : Network
        The cameras.
    times_s : (N,) float64
        Of the images; the first `references` are of the robot standing still.
    poses : (N, 3) float64
        x, y (m) and heading (rad) of the robot in the world.
    speeds : (N, 3) float64
        Their derivatives by time.
    robot : tuple of Surface
        Robot frame; the first are the rig's boards in its order.
    things : tuple of Surface
        What stands beside the area, world frame.
    room : tuple of Surface
        What is behind all that, world frame.
    """

    settings: SessionSettings
    rig: Rig
    network: Network
    times_s: FloatArray
    poses: FloatArray
    speeds: FloatArray
    robot: tuple[Surface, ...]
    things: tuple[Surface, ...]
    room: tuple[Surface, ...]
    _backgrounds: dict[int, Grey] = field(default_factory=dict)

    @property
    def references(self) -> int:
        """How many of the images are of the robot standing still."""
        return self.settings.references

    @cached_property
    def camera_from_world(self) -> FloatArray:
        """(C, 4, 4) inverses of the cameras' poses."""
        return inverse(self.network.world_from_camera)

    def prefix(self, frame: int) -> str:
        """Name of a frame's image, without extension; the same for all cameras."""
        return f"{self.settings.name}.{frame:04d}"

    def background(self, camera: int) -> Grey:
        """(H, W) float32 what a camera sees of the room without robot; worked out once."""
        if camera not in self._backgrounds:
            model = self.network.cameras[camera]
            seen = [lit(s).moved(self.camera_from_world[camera]) for s in self.room]
            empty = np.full((model.height, model.width), 0.3, np.float32)
            self._backgrounds[camera] = render_light(model, [seen], empty, fine=False)
        return self._backgrounds[camera]

    def illumination(self, camera: int) -> Grey:
        """(H, W) float32 vignetting and unevenness of a camera's image, the same at all times."""
        model = self.network.cameras[camera]
        rng = random_for(self.settings.seed, "light", camera)
        return uneven_light(rng, model.width, model.height, 0.6, 0)


@dataclass(frozen=True, eq=False)
class View:
    """What one camera saw at one time."""

    image: NDArray[np.uint8]
    markers: tuple[MarkerTruth, ...]
    """The rig's markers that have any part in view."""


def plan_session(settings: SessionSettings) -> SessionPlan:
    """Build the room and the robot, and drive.

    Parameters
    ----------
    settings : SessionSettings

    Returns
    -------
    SessionPlan

    Raises
    ------
    ValueError
        If there are not 1 to 4 cameras.
    """
    seed = settings.seed
    if not 1 <= settings.cameras <= len(CAMERA_NAMES):
        raise ValueError(f"{settings.cameras} cameras: expected 1 to {len(CAMERA_NAMES)}")
    names = tuple(CAMERA_NAMES[: settings.cameras])
    cameras, world_from_camera = room_cameras(
        random_for(seed, "cameras"), settings.cameras, settings.area_m, settings.width,
        settings.height,
    )  # fmt: skip
    count = len(names)
    network = Network(
        names, cameras, tuple(f"{name}/{name}.cam" for name in names), world_from_camera,
        np.zeros((6 * count, 6 * count)),
    )  # fmt: skip
    rig = robot_rig(random_for(seed, "rig"), settings.dictionary, settings.marker_m)
    times_s, poses, speeds = _drive(settings, random_for(seed, "drive"))
    room = room_surfaces(random_for(seed, "room"), settings.area_m, settings.dictionary)
    return SessionPlan(
        settings=settings,
        rig=rig,
        network=network,
        times_s=times_s,
        poses=poses,
        speeds=speeds,
        robot=tuple(robot_surfaces(rig, random_for(seed, "robot"))),
        things=tuple(obstacles(random_for(seed, "room", 1), settings.area_m)),
        room=tuple(room),
    )


def _drive(
    settings: SessionSettings, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, poses and speeds: standing at random places, then a figure of eight."""
    area = np.array(settings.area_m)
    half = 0.5 * area - 0.55
    standing = np.column_stack(
        [
            0.5 * area + half * rng.uniform(-1.0, 1.0, (settings.references, 2)),
            rng.uniform(-np.pi, np.pi, settings.references),
        ]
    )
    # A figure of eight whose loops slowly turn, so that no two rounds are the same.
    length = 2.0 * np.pi * np.hypot(0.75 * half[0], 1.1 * half[1])
    rate = 2.0 * np.pi * settings.speed_m_s / length
    t = np.arange(settings.steps) / settings.rate_hz
    phase, drift = rng.uniform(0.0, 2.0 * np.pi, 2)

    def place(t: FloatArray) -> FloatArray:
        x = np.sin(rate * t + phase)
        y = np.sin(2.0 * rate * t + 2.0 * phase + 0.6 * np.sin(0.13 * rate * t + drift))
        return np.column_stack([x, y]) * half + 0.5 * area

    def pose(t: FloatArray) -> FloatArray:
        step = 1e-3
        forward = place(t + step) - place(t - step)
        return np.column_stack([place(t), np.arctan2(forward[:, 1], forward[:, 0])])

    poses, later = pose(t), pose(t + 1e-3)
    change = later - poses
    change[:, 2] = np.angle(np.exp(1j * change[:, 2]))
    times = np.concatenate(
        [
            _FIRST_S + _STANDING_S * np.arange(settings.references),
            _FIRST_S + _STANDING_S * settings.references + t,
        ]
    )
    speeds = np.concatenate([np.zeros((settings.references, 3)), change / 1e-3])
    return times, np.concatenate([standing, poses]), speeds


def view_frame(plan: SessionPlan, camera: int, frame: int) -> View:
    """What a camera sees at one of the session's times; depends on no other frame."""
    return view_robot(plan, camera, plan.poses[frame], plan.speeds[frame], frame)


def view_robot(
    plan: SessionPlan, camera: int, pose: FloatArray, speed: FloatArray, noise: int
) -> View:
    """What a camera sees of the robot.

    Parameters
    ----------
    plan : SessionPlan
        The session.
    camera : int
        Which one of its cameras.
    pose, speed : (3,) float64
        x, y (m) and heading (rad) of the robot in the world, and their derivatives (1/s).
    noise : int
        Chooses the noise, together with seed and camera.

    Returns
    -------
    View
    """
    settings, model = plan.settings, plan.network.cameras[camera]
    camera_from_world = plan.camera_from_world[camera]
    exposures = [
        _surfaces(plan, camera_from_world, pose + offset * settings.exposure_s * speed)
        for offset in _instants(plan, camera_from_world, model, pose, speed)
    ]
    imaging = Imaging(settings.blur_px, 6.0, 280.0, settings.noise_grey)
    background = _shadowed(plan, camera, pose)
    light = render_light(model, exposures, background, fine=imaging.fine, samples=settings.samples)
    illumination = plan.illumination(camera)
    rng = random_for(settings.seed, "frame", camera, noise)
    image = grey_image(light, illumination, imaging, rng)
    surfaces = _surfaces(plan, camera_from_world, pose)
    return View(image, _markers(plan, model, surfaces, illumination, imaging.gain))


def _surfaces(plan: SessionPlan, camera_from_world: FloatArray, pose: FloatArray) -> list[Surface]:
    """Robot and obstacles in the camera frame, first the rig's boards."""
    world_from_robot = planar_transform(*(float(x) for x in pose))
    robot = [lit(surface.moved(world_from_robot)) for surface in plan.robot]
    return [surface.moved(camera_from_world) for surface in [*robot, *plan.things]]


def _instants(
    plan: SessionPlan,
    camera_from_world: FloatArray,
    model: Camera,
    pose: FloatArray,
    speed: FloatArray,
) -> FloatArray:
    """When the robot is looked at, in shares of the exposure from its middle: every pixel."""
    points = plan.rig.robot_from_marker[:, :3, 3]
    ends = []
    for offset in (-0.5, 0.5):
        moved = pose + offset * plan.settings.exposure_s * speed
        world = apply(planar_transform(*(float(x) for x in moved)), points)
        ends.append(model.project(apply(camera_from_world, world)))
    way = np.nan_to_num(np.linalg.norm(ends[1] - ends[0], axis=1)).max()
    count = int(np.clip(np.ceil(way), 1, _MOST_EXPOSURES))
    return (np.arange(count) + 0.5) / count - 0.5


def _shadowed(plan: SessionPlan, camera: int, pose: FloatArray) -> Grey:
    """The background with the robot's soft shadow on the floor."""
    import cv2

    background, model = plan.background(camera), plan.network.cameras[camera]
    x, y = 1.15 * np.array(FOOTPRINT_M)
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    world = apply(planar_transform(*(float(p) for p in pose)), corners)
    pixels = model.project(apply(plan.camera_from_world[camera], world))
    if np.isnan(pixels).any():
        return background
    mask = np.zeros(background.shape, np.uint8)
    cv2.fillConvexPoly(mask, np.rint(pixels).astype(np.int32), 255)
    left, top, width, height = cv2.boundingRect(np.rint(pixels).astype(np.int32))
    soft = max(3.0, 0.06 * width)
    reach = int(3.0 * soft)
    window = (
        slice(max(top - reach, 0), max(top + height + reach, 0)),
        slice(max(left - reach, 0), max(left + width + reach, 0)),
    )
    if background[window].size == 0:
        return background
    shadow = cv2.GaussianBlur(mask[window], (0, 0), soft).astype(np.float32)
    darker = background.copy()
    darker[window] *= np.float32(1.0) - np.float32(_SHADOW / 255.0) * shadow
    return darker


def _markers(
    plan: SessionPlan, model: Camera, surfaces: list[Surface], illumination: Grey, gain: float
) -> tuple[MarkerTruth, ...]:
    result = []
    arrays = SurfaceArrays(model, surfaces)
    for which, (marker, width) in enumerate(zip(plan.rig.ids, plan.rig.widths_m)):
        card = surfaces[which]
        visible, rim = visible_shares(model, surfaces, which, float(width), arrays)
        corners = marker_corners(model, card.pose, float(width))
        if visible == 0.0 or np.isnan(corners).any():
            continue
        u, v = np.clip(
            np.rint(corners.mean(axis=0)).astype(int), 0, [model.width - 1, model.height - 1]
        )
        lightest = float(np.nanmax(card.texture.values)) / WHITE
        contrast = gain * float(illumination[v, u]) * (WHITE - BLACK) * lightest
        result.append(
            MarkerTruth(
                plan.rig.dictionary, int(marker), corners, card.pose, float(width),
                mean_side_px(corners), slant_deg(card.pose), contrast, visible, rim,
            )
        )  # fmt: skip
    return tuple(result)
