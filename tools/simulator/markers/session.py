"""A session in a room: where the robot drives, what each camera sees, and its folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np

from camera import Camera, format_camera, write_camera
from redetect.array_types import ByteArray, Float32Array, FloatArray
from redetect.groundtruth.markers.session import Network, Rig, write_network, write_rig
from redetect.groundtruth.trajectories import se3
from redetect.groundtruth.trajectories.streams import PlanarPoses, write_planar_poses
from redetect.storage import write_bytes
from tools.simulator.driving import planar_transform
from tools.simulator.files import encoded, rounded, write_lines, write_truth
from tools.simulator.markers.rendering import (
    Imaging,
    grey_image,
    render_light,
    surface_arrays,
    uneven_light,
)
from tools.simulator.markers.room import (
    CAMERA_NAMES,
    FOOTPRINT_M,
    lit,
    obstacles,
    robot_rig,
    robot_surfaces,
    room_cameras,
    room_surfaces,
)
from tools.simulator.markers.surface import BLACK, WHITE, Surface
from tools.simulator.markers.truth import MarkerTruth, marker_truth
from tools.simulator.parallel import in_order


@dataclass(frozen=True)
class CalibrationErrors:
    """Standard deviations of the errors of cameras and robot in a session's files."""

    network_m: float = 0.0  # Of each camera's place along each axis (m).
    network_deg: float = 0.0  # Of each camera's rotation about each axis (degrees).
    rig_m: float = 0.0  # Of each marker's place on the robot along each axis (m).
    rig_deg: float = 0.0  # Of each marker's rotation about each axis (degrees).
    focal: float = 0.0  # Of the focal lengths, as a share of them.
    centre_px: float = 0.0  # Of the principal point along each axis (pixels).


def disturbed_network(
    network: Network, errors: CalibrationErrors, rng: np.random.Generator
) -> Network:
    """The network as a calibration with such errors would have it, covariances included."""
    count = len(network.names)
    sigmas = _sigmas(errors.network_m, errors.network_deg)
    poses = network.world_from_camera @ se3.exp(sigmas * rng.standard_normal((count, 6)))
    cameras = tuple(_disturbed_lens(camera, errors, rng) for camera in network.cameras)
    return replace(
        network, cameras=cameras, world_from_camera=poses,
        covariance=np.diag(np.tile(sigmas**2, count)),
    )  # fmt: skip


def disturbed_rig(rig: Rig, errors: CalibrationErrors, rng: np.random.Generator) -> Rig:
    """The rig as a calibration with such errors would have it; see `disturbed_network`."""
    count = len(rig.ids)
    sigmas = _sigmas(errors.rig_m, errors.rig_deg)
    poses = rig.robot_from_marker @ se3.exp(sigmas * rng.standard_normal((count, 6)))
    return replace(rig, robot_from_marker=poses, covariance=np.diag(np.tile(sigmas**2, count)))


def _disturbed_lens(camera: Camera, errors: CalibrationErrors, rng: np.random.Generator) -> Camera:
    factor = 1.0 + errors.focal * rng.standard_normal()
    du, dv = errors.centre_px * rng.standard_normal(2)
    return replace(
        camera, scale_x=camera.scale_x * factor, scale_y=camera.scale_y * factor,
        offset_x=camera.offset_x + float(du), offset_y=camera.offset_y + float(dv),
    )  # fmt: skip


def _sigmas(metres: float, degrees: float) -> FloatArray:
    return np.repeat([metres, np.radians(degrees)], 3)


_FIRST_S = 1000.0
_STANDING_S = 2.0
_MOST_EXPOSURES = 4
_SHADOW = 0.45


@dataclass(frozen=True)
class SessionSettings:
    """Settings of a session."""

    name: str = "session"  # Its name; those of the images begin with it.
    seed: int = 1  # Everything about it follows from this.
    cameras: int = 4  # Cameras in the corners of the room, 1 to 4.
    area_m: tuple[float, float] = (6.0, 4.5)  # Extent of the area in which the robot drives (m).
    width: int = 1280  # Of the images (pixels).
    height: int = 960  # Of the images (pixels).
    references: int = 23  # Poses at which the robot stands still, before the drive.
    steps: int = 300  # Images of the drive per camera.
    rate_hz: float = 5.0  # Images per second of the drive.
    speed_m_s: float = 0.35  # Mean speed of the drive (m/s).
    exposure_s: float = 0.012  # How long the shutter is open (s).
    dictionary: str = "rawseeds"  # Set of the robot's markers.
    marker_m: float = 0.2  # Width of the black squares (m).
    blur_px: float = 0.8  # Standard deviation of the optics' blur (pixels).
    noise_grey: float = 2.0  # Standard deviation of the noise (grey levels).
    samples: int = 16  # Rays in each quarter of a pixel that an edge crosses.

    @property
    def imaging(self) -> Imaging:
        """How light becomes grey values."""
        return Imaging(self.blur_px, 6.0, 280.0, self.noise_grey)


Purpose = Literal["rig", "cameras", "room", "robot", "drive", "errors", "light", "boards", "frame"]
_PURPOSES = get_args(Purpose)


def random_for(seed: int, purpose: Purpose, *which: int) -> np.random.Generator:
    """A stream of random numbers of its own for each purpose: changing one leaves the others."""
    return np.random.default_rng(np.random.SeedSequence([seed, _PURPOSES.index(purpose), *which]))


@dataclass(frozen=True, eq=False)
class SessionPlan:
    """A session that only has to be rendered, without errors."""

    settings: SessionSettings
    rig: Rig  # The robot's markers.
    network: Network  # The cameras.
    times_s: FloatArray
    """(N,) Of the images; the first `references` are of the robot standing still."""
    poses: FloatArray  # (N, 3) x, y (m) and heading (rad) of the robot in the world.
    speeds: FloatArray  # (N, 3) Their derivatives by time.
    robot: tuple[Surface, ...]  # Robot frame; the first are the rig's boards in its order.
    things: tuple[Surface, ...]  # What stands beside the area, world frame.
    room: tuple[Surface, ...]  # What is behind all that, world frame.
    _backgrounds: dict[int, Float32Array] = field(default_factory=dict)

    @cached_property
    def camera_from_world(self) -> FloatArray:
        """(C, 4, 4) inverses of the cameras' poses."""
        return se3.inverse(self.network.world_from_camera)

    def prefix(self, frame: int) -> str:
        """Name of a frame's image, without extension; the same for all cameras."""
        return f"{self.settings.name}.{frame:04d}"

    def background(self, camera: int) -> Float32Array:
        """(H, W) float32 view of the room without robot; rendered once per camera."""
        if camera not in self._backgrounds:
            model = self.network.cameras[camera]
            seen = [lit(s).moved(self.camera_from_world[camera]) for s in self.room]
            empty = np.full((model.height, model.width), 0.3, np.float32)
            self._backgrounds[camera] = render_light(model, [seen], empty, fine=False)
        return self._backgrounds[camera]

    def illumination(self, camera: int) -> Float32Array:
        """(H, W) float32 vignetting and unevenness of a camera's image, the same at all times."""
        model = self.network.cameras[camera]
        rng = random_for(self.settings.seed, "light", camera)
        return uneven_light(rng, model.width, model.height, 0.6, 0)

    def image(
        self, camera: int, exposures: list[list[Surface]], background: Float32Array, noise: int
    ) -> ByteArray:
        """(H, W) image that a camera takes of surfaces in its frame; `noise` seeds the noise."""
        settings, model = self.settings, self.network.cameras[camera]
        imaging, samples = settings.imaging, settings.samples
        light = render_light(model, exposures, background, fine=imaging.fine, samples=samples)
        rng = random_for(settings.seed, "frame", camera, noise)
        return grey_image(light, self.illumination(camera), imaging, rng)


@dataclass(frozen=True, eq=False)
class View:
    """What one camera saw at one time."""

    image: ByteArray
    markers: tuple[MarkerTruth, ...]  # The rig's markers that have any part in view.


def plan_session(settings: SessionSettings) -> SessionPlan:
    """Build the room and the robot, and drive."""
    seed = settings.seed
    if not 1 <= settings.cameras <= len(CAMERA_NAMES):
        raise ValueError(f"{settings.cameras} cameras: expected 1 to {len(CAMERA_NAMES)}")
    area_m, dictionary, count = settings.area_m, settings.dictionary, settings.cameras
    names = tuple(CAMERA_NAMES[:count])
    cameras, world_from_camera = room_cameras(
        random_for(seed, "cameras"), count, area_m, settings.width, settings.height
    )
    files = tuple(f"{name}/{name}.cam" for name in names)
    known = np.zeros((6 * count, 6 * count))
    network = Network(names, cameras, files, world_from_camera, known)
    rig = robot_rig(random_for(seed, "rig"), dictionary, settings.marker_m)
    return SessionPlan(
        settings, rig, network, *_drive(settings, random_for(seed, "drive")),
        robot=tuple(robot_surfaces(rig, random_for(seed, "robot"))),
        things=tuple(obstacles(random_for(seed, "room", 1), area_m)),
        room=tuple(room_surfaces(random_for(seed, "room"), area_m, dictionary)),
    )  # fmt: skip


def _drive(
    settings: SessionSettings, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, poses and speeds: standing at random places, then a figure of eight."""
    area = np.array(settings.area_m)
    half = 0.5 * area - 0.55
    still = settings.references
    standing = np.column_stack(
        [0.5 * area + half * rng.uniform(-1.0, 1.0, (still, 2)), rng.uniform(-np.pi, np.pi, still)]
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
    times = _FIRST_S + np.concatenate([_STANDING_S * np.arange(still), _STANDING_S * still + t])
    speeds = np.concatenate([np.zeros((still, 3)), change / 1e-3])
    return times, np.concatenate([standing, poses]), speeds


def view_frame(plan: SessionPlan, which: tuple[int, int]) -> View:
    """What a camera sees in a frame (both by number); depends on no other frame."""
    camera, frame = which
    return view_robot(plan, camera, plan.poses[frame], plan.speeds[frame], frame)


def view_robot(
    plan: SessionPlan, camera: int, pose: FloatArray, speed: FloatArray, noise: int
) -> View:
    """What a camera sees of the robot. `pose`, `speed` (3,)."""
    camera_from_world = plan.camera_from_world[camera]
    exposures = [
        _surfaces(plan, camera_from_world, pose + offset * plan.settings.exposure_s * speed)
        for offset in _instants(plan, camera, pose, speed)
    ]
    image = plan.image(camera, exposures, _shadowed(plan, camera, pose), noise)
    return View(image, seen_markers(plan, camera, pose))


def _surfaces(plan: SessionPlan, camera_from_world: FloatArray, pose: FloatArray) -> list[Surface]:
    """Robot and obstacles in the camera frame, first the rig's boards."""
    world_from_robot = planar_transform(*pose.tolist())
    robot = [lit(surface.moved(world_from_robot)) for surface in plan.robot]
    return [surface.moved(camera_from_world) for surface in [*robot, *plan.things]]


def _instants(plan: SessionPlan, camera: int, pose: FloatArray, speed: FloatArray) -> FloatArray:
    """Instants of an exposure, as shares from its middle: one for each pixel of motion."""
    points, half = plan.rig.robot_from_marker[:, :3, 3], 0.5 * plan.settings.exposure_s * speed
    ends = [_pixels(plan, camera, moved, points) for moved in (pose - half, pose + half)]
    way = np.nan_to_num(np.linalg.norm(ends[1] - ends[0], axis=1)).max()
    count = int(np.clip(np.ceil(way), 1, _MOST_EXPOSURES))
    return (np.arange(count) + 0.5) / count - 0.5


def _pixels(plan: SessionPlan, camera: int, pose: FloatArray, points: FloatArray) -> FloatArray:
    """(N, 2) where a camera sees points of the robot at a pose. `points` (N, 3)."""
    world = se3.apply(planar_transform(*pose.tolist()), points)
    return plan.network.cameras[camera].project(se3.apply(plan.camera_from_world[camera], world))


def _shadowed(plan: SessionPlan, camera: int, pose: FloatArray) -> Float32Array:
    """The background with the robot's soft shadow on the floor."""
    background = plan.background(camera)
    x, y = 1.15 * np.array(FOOTPRINT_M)
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    pixels = _pixels(plan, camera, pose, corners)
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


def seen_markers(plan: SessionPlan, camera: int, pose: FloatArray) -> tuple[MarkerTruth, ...]:
    """The rig's markers that have any part in view of a camera. `pose` (3,)."""
    model, illumination = plan.network.cameras[camera], plan.illumination(camera)
    surfaces = _surfaces(plan, plan.camera_from_world[camera], pose)
    result = []
    arrays = surface_arrays(model, surfaces)
    for which, (marker, width) in enumerate(zip(plan.rig.ids, plan.rig.widths_m)):
        known = plan.rig.dictionary, int(marker), float(width)
        truth = marker_truth(model, surfaces, which, known, arrays)
        if truth.visible == 0.0 or np.isnan(truth.corners).any():
            continue
        middle = np.rint(truth.corners.mean(axis=0)).astype(int)
        u, v = np.clip(middle, 0, [model.width - 1, model.height - 1])
        lightest = float(np.nanmax(surfaces[which].texture.values)) / WHITE
        light = plan.settings.imaging.gain * float(illumination[v, u])
        result.append(replace(truth, contrast_grey=light * (WHITE - BLACK) * lightest))
    return tuple(result)


ImageFormat = Literal["png", "jpg"]

NOTE = (
    "SIMULATED, rendered by tools/simulator: no real robot drove here, and no real room looks "
    "like this"
)

_CONVENTIONS = {
    "world": "metres, z up, the floor is z = 0; the robot's area spans x and y from 0",
    "robot": "origin on the floor, x forward, y left, z up; theta: heading of x in the world, "
    "counter-clockwise (rad)",
    "marker": "origin at its centre, x right, y up, z out of the printed face; corners top left, "
    "top right, bottom right, bottom left of the marker as printed",
    "camera": "x right, y down, z forward; pixels u right, v down, (0, 0) the centre of the top "
    "left pixel; corners are where the lens images them, distortion included",
    "visible": "share of the black square that is in the image and not hidden; rim_visible: of the "
    "white rim round it",
}


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """The truth of one image."""

    camera: str
    prefix: str
    time_s: float
    markers: tuple[MarkerTruth, ...]


@dataclass(frozen=True)
class SessionWriter:
    """How a session's files are written."""

    errors: CalibrationErrors = CalibrationErrors()
    """Of what the calibration files say; images are always rendered with the true ones."""
    image_format: ImageFormat = "jpg"  # `png` without loss, or `jpg`.
    quality: int = 92  # Of the jpg files.
    overwrite: bool = False  # Whether existing files may be replaced.

    def calibrations(self, plan: SessionPlan, folder: Path) -> None:
        """Write ``network.json``, ``rig.json`` and a ``.cam`` per camera; make the folders."""
        seed = plan.settings.seed
        network = disturbed_network(plan.network, self.errors, random_for(seed, "errors", 0))
        rig = disturbed_rig(plan.rig, self.errors, random_for(seed, "errors", 1))
        for name, camera in zip(network.names, network.cameras):
            (folder / name / "images").mkdir(parents=True, exist_ok=True)
            write_camera(camera, folder / name / f"{name}.cam", overwrite=self.overwrite)
        extra = {"note": NOTE, "errors": asdict(self.errors)}
        write_network(folder / "network.json", network, extra, overwrite=self.overwrite)
        write_rig(folder / "rig.json", rig, extra, overwrite=self.overwrite)

    def image(self, folder: Path, camera: str, prefix: str, image: ByteArray) -> str:
        """Write a camera's image; returns its place in the session's folder."""
        place = f"{camera}/images/{prefix}.{self.image_format}"
        content = encoded(image, f".{self.image_format}", self.quality)
        write_bytes(folder / place, content, overwrite=self.overwrite)
        return place

    def times(self, folder: Path, plan: SessionPlan, seen: Sequence[SeenFrame]) -> None:
        """Write the rows ``prefix seconds`` of each camera's images, in the order of time."""
        for name in plan.network.names:
            own = sorted((s for s in seen if s.camera == name), key=lambda s: s.time_s)
            rows = [f"# {NOTE}", "# image seconds", *(f"{s.prefix} {s.time_s:.6f}" for s in own)]
            write_lines(folder / name / f"{name}.times", rows, overwrite=self.overwrite)

    def poses(self, path: Path, times_s: FloatArray, poses: FloatArray) -> None:
        """Write rows t, x, y, theta as RAWSEEDS' streams have them."""
        write_planar_poses(path, PlanarPoses(times_s, poses), overwrite=self.overwrite)

    def truth(
        self, path: Path, plan: SessionPlan, seen: Sequence[SeenFrame],
        extra: dict[str, Any] | None = None,
    ) -> None:  # fmt: skip
        """Write the truth: true calibrations, and markers image by image."""
        network, rig = plan.network, plan.rig
        head: dict[str, Any] = {
            "note": NOTE,
            "conventions": _CONVENTIONS,
            "settings": asdict(plan.settings),
            "errors": asdict(self.errors),
            "references": plan.settings.references,
            "cameras": {
                name: {"calibration": format_camera(camera), "world_from_camera": _rows_of(pose)}
                for name, camera, pose in zip(
                    network.names, network.cameras, network.world_from_camera
                )
            },
            "markers": {
                str(marker): {"width_m": float(width), "robot_from_marker": _rows_of(pose)}
                for marker, width, pose in zip(rig.ids, rig.widths_m, rig.robot_from_marker)
            },
            **(extra or {}),
        }
        frames = [
            {"camera": s.camera, "image": s.prefix, "t": s.time_s,
             "markers": [_marker_json(m) for m in s.markers]}
            for s in seen
        ]  # fmt: skip
        write_truth(path, head, {"frames": frames}, overwrite=self.overwrite)


def write_session(
    settings: SessionSettings, folder: Path, writer: SessionWriter | None = None, jobs: int = 1
) -> int:
    """Render a session and write its folder."""
    plan, writer = plan_session(settings), writer or SessionWriter()
    names = plan.network.names
    writer.calibrations(plan, folder)
    work = [(c, f) for c in range(len(names)) for f in range(len(plan.times_s))]
    seen: list[SeenFrame] = []
    for (camera, frame), view in zip(work, in_order(partial(view_frame, plan), work, jobs)):
        prefix = plan.prefix(frame)
        writer.image(folder, names[camera], prefix, view.image)
        seen.append(SeenFrame(names[camera], prefix, float(plan.times_s[frame]), view.markers))
    writer.times(folder, plan, seen)
    writer.poses(folder / "truth.csv", plan.times_s, plan.poses)
    still = slice(0, plan.settings.references)
    writer.poses(folder / "reference.csv", plan.times_s[still], plan.poses[still])
    writer.truth(folder / "truth.json", plan, seen)
    return len(work)


def _rows_of(pose: FloatArray) -> list[list[float]]:
    """A (4, 4) transform's first three rows as plain numbers."""
    return [rounded(row, 12) for row in pose[:3]]


def _marker_json(marker: MarkerTruth) -> dict[str, Any]:
    numbers = marker.as_json()
    for known in ("dictionary", "width_m", "camera_from_marker"):
        del numbers[known]
    numbers["corners"] = np.round(marker.corners, 4).tolist()
    return numbers


DEMO = SessionSettings(
    name="m",
    seed=5,
    cameras=2,
    area_m=(2.2, 1.8),
    width=800,
    height=600,
    references=4,
    steps=14,
    rate_hz=1.0,
    speed_m_s=0.3,
)
DEMO_QUALITY = 90
