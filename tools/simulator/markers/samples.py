"""Random frames for statistics of detection: markers and things that resemble them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from camera import Camera, format_camera, write_camera
from camera.uncertainty import IDENTITY
from detect.markers.dictionaries import marker_dictionary
from redetect.array_types import ByteArray, Float32Array, FloatArray
from redetect.groundtruth.trajectories import se3
from redetect.storage import write_bytes
from tools.simulator.files import encoded, write_truth
from tools.simulator.markers.kernels import SurfaceArrays
from tools.simulator.markers.rendering import (
    SAMPLES,
    Imaging,
    grey_image,
    render_light,
    surface_arrays,
    uneven_light,
)
from tools.simulator.markers.surface import (
    BLACK,
    WHITE,
    Surface,
    Texture,
    box_against,
    box_sides,
    marker_surface,
    plain,
)
from tools.simulator.markers.things import (
    blotches,
    near_marker,
    photograph_background,
    photograph_files,
    shapes_background,
    thing,
)
from tools.simulator.markers.truth import MarkerTruth, marker_corners, marker_truth, mean_side_px
from tools.simulator.parallel import in_order

_TRIES = 12
_BEHIND_M = 1e-3


class Placed(NamedTuple):
    """A disc of the image that is taken."""

    pixel: FloatArray
    radius_px: float


def place(
    rng: np.random.Generator,
    camera: Camera,
    taken: Sequence[Placed],
    width_px: float,
    *,
    inside: bool,
) -> Placed | None:
    """Find a place in the image that nothing has taken."""
    radius = 0.85 * width_px
    size = np.array([camera.width, camera.height], dtype=np.float64)
    margin = np.minimum(radius + 3.0, 0.49 * size) if inside else np.zeros(2)
    for _ in range(_TRIES):
        pixel = margin + rng.random(2) * (size - 1.0 - 2.0 * margin)
        if all(np.hypot(*(pixel - p.pixel)) > radius + p.radius_px for p in taken):
            return Placed(pixel, radius)
    return None


def random_pose(
    rng: np.random.Generator,
    camera: Camera,
    pixel: FloatArray,
    width_px: float,
    slant_deg: float,
    width_m: float,
) -> FloatArray:
    """(4, 4) camera_from_marker of a square seen at a pixel with a given mean side and slant.

    Its turn in its own plane and the direction in which it slants are random.
    """
    ray = camera.unproject(pixel)
    ray /= np.linalg.norm(ray)
    toward = -ray
    across = np.cross(toward, np.array([0.0, 1.0, 0.0]))
    across /= np.linalg.norm(across)
    upward = np.cross(toward, across)
    direction = rng.uniform(0.0, 2.0 * np.pi)
    sideways = np.cos(direction) * across + np.sin(direction) * upward
    slant = np.radians(slant_deg)
    normal = np.cos(slant) * toward + np.sin(slant) * sideways
    turn = rng.uniform(0.0, 2.0 * np.pi)
    other = np.cross(normal, toward if slant > 0.1 else across)
    other /= np.linalg.norm(other)
    x = np.cos(turn) * other + np.sin(turn) * np.cross(normal, other)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = x, np.cross(normal, x), normal
    distance = camera.scale_x * width_m / width_px
    for _ in range(4):
        pose[:3, 3] = distance * ray
        side = mean_side_px(marker_corners(camera, pose, width_m))
        if not np.isfinite(side):  # so near that a corner is out of sight
            break
        distance *= side / width_px
        if abs(side / width_px - 1.0) < 1e-3:
            break
    # Never so near that the square reaches the camera's plane.
    pose[:3, 3] = max(distance, 1.2 * width_m) * ray
    return pose


def backing_box(rng: np.random.Generator, card: Surface) -> list[Surface]:
    """A box whose front carries the card: its five sides, in the card's parent frame."""
    wider = 1.0 + rng.uniform(0.05, 1.2, 2)
    across, upward = card.width_m * wider[0], card.height_m * wider[1]
    depth = rng.uniform(0.3, 1.2) * card.width_m
    slack = 0.5 * (np.array([across, upward]) - [card.width_m, card.height_m])
    shift = slack * rng.uniform(-1.0, 1.0, 2)
    foot = shift[0], shift[1] - 0.5 * upward, -0.5 * depth - _BEHIND_M
    shade = rng.uniform(0.08, 0.85)
    textures: dict[str, Texture] = {
        side: plain(float(np.clip(shade * rng.uniform(0.5, 1.2), 0.03, 0.95)))
        for side in ("front", "left", "right", "top")
    }
    if rng.random() < 0.4:
        pattern = shade + 0.25 * (blotches(rng, (48, 64), octaves=3) - np.float32(0.5))
        textures["front"] = Texture(np.clip(pattern, 0.03, 0.95).astype(np.float32), smooth=True)
    return box_sides((depth, across, upward), textures, card.pose @ box_against(foot))


_MARKER_M = 0.2
_WHITEST = 252.0
_MOST_EXPOSURES = 8


@dataclass(frozen=True)
class SampleSettings:
    """Settings of random frames. Widths, blurs and contrasts are uniform in their logarithms, all
    others are uniform.
    """

    dictionaries: tuple[str, ...] = ("rawseeds",)
    """Sets of markers; each frame has markers of one of them."""
    width: int = 640
    height: int = 480
    empty: float = 0.25  # Share of frames without any marker.
    markers: tuple[int, int] = (1, 4)  # Fewest and most markers in the other frames.
    width_px: tuple[float, float] = (12.0, 200.0)  # Mean side length of the markers (pixels).
    slant_deg: tuple[float, float] = (0.0, 70.0)
    """Between a marker's normal and the line to the camera (degrees)."""
    blur_px: tuple[float, float] = (0.3, 3.0)  # Standard deviation of the optics' blur (pixels).
    contrast_grey: tuple[float, float] = (15.0, 200.0)
    """White minus black (grey levels), before uneven light."""
    noise_grey: tuple[float, float] = (1.0, 5.0)  # Standard deviation of the noise (grey levels).
    motion: float = 0.15  # Share of frames with motion blur.
    motion_px: tuple[float, float] = (0.5, 8.0)  # Length of the way during exposure (pixels).
    uneven: float = 0.7  # Share of frames with uneven light.
    occluded: float = 0.12  # Share of markers with something before them.
    cut: float = 0.05  # Share of markers that may reach over the image's border.
    boxed: float = 0.5  # Share of markers and other things that stand on a box.
    things: tuple[int, int] = (1, 5)
    """Fewest and most other things in frames with markers; twice as many in those without."""
    near: float = 0.25  # Share of those things that are black squares of no dictionary.
    cameras: Literal["pinhole", "distorted", "mixed"] = "mixed"
    """Through which calibrations the frames are seen."""
    photographs: Path | None = None  # Folder of photographs to be backgrounds of half the frames.
    samples: int = SAMPLES  # Rays in each quarter of a pixel that an edge crosses.


@dataclass(frozen=True, eq=False)
class SampleFrame:
    """A random frame and its truth."""

    seed: int
    index: int
    image: ByteArray
    camera: Camera
    dictionary: str  # The set that the frame's markers are from, or would be.
    markers: tuple[MarkerTruth, ...]
    things: tuple[str, ...]  # What else there is.
    imaging: Imaging
    motion_px: float

    def as_json(self) -> dict[str, Any]:
        """Everything except the image, as JSON."""
        return {
            "seed": self.seed,
            "index": self.index,
            "dictionary": self.dictionary,
            "blur_px": round(self.imaging.blur_px, 4),
            "noise_grey": round(self.imaging.noise_grey, 4),
            "motion_px": round(self.motion_px, 3),
            "things": list(self.things),
            "markers": [marker.as_json() for marker in self.markers],
        }


@cache
def sample_cameras(width: int, height: int) -> tuple[Camera, ...]:
    """A pinhole, an ordinary lens and a wide one."""
    centre = 0.5 * (width - 1) + 3.3, 0.5 * (height - 1) - 2.7
    lenses = (
        (0.95, (0.0, 0.0, 0.0, 0.0, 0.0)),
        (0.85, (0.0, -0.16, 0.0, 0.15, 0.0)),
        (0.61, (-0.0620672, -0.324903, 0.314764, 1.52524, -0.480806)),
    )
    return tuple(
        Camera(width, height, f * width, f * width, *centre, coef, IDENTITY) for f, coef in lenses
    )


def sample_frame(settings: SampleSettings, seed: int, index: int) -> SampleFrame:
    """Render one frame."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, index]))
    camera = _camera(settings, rng)
    name = settings.dictionaries[rng.integers(len(settings.dictionaries))]
    scene = _Scene(settings, camera, name, rng)
    if rng.random() >= settings.empty:
        for _ in range(int(rng.integers(settings.markers[0], settings.markers[1] + 1))):
            scene.add_marker()
    factor = 1 if scene.cards else 2
    low, high = settings.things
    for _ in range(int(rng.integers(factor * low, factor * high + 1))):
        scene.add_thing()

    imaging = _imaging(settings, rng)
    illumination: Any = np.float32(1.0)
    if rng.random() < settings.uneven:
        illumination = uneven_light(
            rng, camera.width, camera.height, rng.random(), int(rng.integers(0, 4))
        )
    background = _background(settings, camera, rng)
    moves, motion_px = _motion(settings, camera, scene.cards, rng)
    exposures = [[surface.moved(move) for surface in scene.surfaces] for move in moves]
    light = render_light(camera, exposures, background, fine=imaging.fine, samples=settings.samples)
    image = grey_image(light, illumination, imaging, rng)
    arrays = surface_arrays(camera, scene.surfaces)
    markers = tuple(_truth(scene, card, arrays, illumination, imaging.gain) for card in scene.cards)
    return SampleFrame(
        seed, index, image, camera, name, markers, tuple(scene.things), imaging, motion_px
    )


class _Scene:
    """Surfaces in the camera frame as they are added."""

    def __init__(
        self, settings: SampleSettings, camera: Camera, dictionary: str, rng: np.random.Generator
    ) -> None:
        self.settings, self.camera, self.rng = settings, camera, rng
        self.dictionary = marker_dictionary(dictionary)
        self.surfaces: list[Surface] = []
        self.cards: list[tuple[int, int]] = []
        self.things: list[str] = []
        self.taken: list[Placed] = []

    def add_marker(self) -> None:
        rng, settings = self.rng, self.settings
        width_px = _log_uniform(rng, settings.width_px)
        slant = rng.uniform(*settings.slant_deg)
        cut = rng.random() < settings.cut
        placed = place(rng, self.camera, self.taken, width_px, inside=not cut)
        marker_id = int(rng.choice(self.dictionary.ids))
        quiet = int(rng.integers(1, 3))
        boxed, occluded = rng.random() < settings.boxed, rng.random() < settings.occluded
        if placed is None:
            return
        pose = random_pose(rng, self.camera, placed.pixel, width_px, slant, _MARKER_M)
        card = marker_surface(self.dictionary, marker_id, _MARKER_M, pose, quiet)
        self.cards.append((len(self.surfaces), marker_id))
        self._put(card, placed, boxed)
        if boxed:
            self.things.append("box")
        if occluded:
            self.surfaces.append(_occluder(rng, card))
            self.things.append("occluder")

    def add_thing(self) -> None:
        rng, settings = self.rng, self.settings
        width_px = _log_uniform(rng, (16.0, 260.0))
        placed = place(rng, self.camera, self.taken, width_px, inside=rng.random() < 0.6)
        if rng.random() < settings.near:
            name, texture = "near_marker", near_marker(rng, self.dictionary)
        else:
            name, texture = thing(rng, self.dictionary)
        slant = rng.uniform(0.0, 70.0)
        width_m = rng.uniform(0.1, 1.5)
        boxed = rng.random() < settings.boxed
        if placed is None:
            return
        pose = random_pose(rng, self.camera, placed.pixel, width_px, slant, width_m)
        rows, columns = texture.values.shape
        self._put(Surface(pose, width_m, width_m * rows / columns, texture, 0.4), placed, boxed)
        self.things.append(name)

    def _put(self, surface: Surface, placed: Placed, boxed: bool) -> None:
        self.taken.append(placed)
        self.surfaces.append(surface)
        if boxed:
            self.surfaces += backing_box(self.rng, surface)


def _camera(settings: SampleSettings, rng: np.random.Generator) -> Camera:
    cameras = sample_cameras(settings.width, settings.height)
    chosen = int(rng.integers(len(cameras)))
    if settings.cameras == "pinhole":
        chosen = 0
    elif settings.cameras == "distorted":
        chosen = max(1, chosen)
    return cameras[chosen]


def _imaging(settings: SampleSettings, rng: np.random.Generator) -> Imaging:
    gain = _log_uniform(rng, settings.contrast_grey) / (WHITE - BLACK)
    highest = max(_WHITEST - WHITE * gain, 1.0)
    return Imaging(
        blur_px=_log_uniform(rng, settings.blur_px),
        black_level=float(rng.uniform(0.0, highest)),
        gain=gain,
        noise_grey=float(rng.uniform(*settings.noise_grey)),
    )


def _background(settings: SampleSettings, camera: Camera, rng: np.random.Generator) -> Float32Array:
    files = () if settings.photographs is None else photograph_files(settings.photographs)
    if files and rng.random() < 0.5:
        return photograph_background(rng, camera.width, camera.height, files)
    return shapes_background(rng, camera.width, camera.height)


def _motion(
    settings: SampleSettings, camera: Camera, cards: list[tuple[int, int]], rng: np.random.Generator
) -> tuple[list[FloatArray], float]:
    """How far everything has turned about the camera at each instant of the exposure."""
    moving = rng.random() < settings.motion
    length = float(rng.uniform(*settings.motion_px))
    direction = rng.uniform(0.0, 2.0 * np.pi)
    if not moving:
        return [np.eye(4)], 0.0
    # Steps of a pixel: the pixel's own width fills the gaps.
    count = int(np.clip(np.ceil(length), 2, _MOST_EXPOSURES))
    axis = np.array([-np.sin(direction), np.cos(direction), 0.0])
    angles = [length / camera.scale_x * ((k + 0.5) / count - 0.5) for k in range(count)]
    turns = (Rotation.from_rotvec(angle * axis).as_matrix() for angle in angles)
    return [se3.transform(turn, np.zeros(3)) for turn in turns], length


def _occluder(rng: np.random.Generator, card: Surface) -> Surface:
    """A plain rectangle between a card and the camera, over one of its sides."""
    reach = rng.uniform(0.6, 1.0)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    offset = rng.uniform(0.45, 0.95) * card.width_m * np.array([np.cos(angle), np.sin(angle)])
    centre = card.pose[:3, 3] + card.pose[:3, :2] @ offset
    pose = card.pose.copy()
    pose[:3, 3] = centre * rng.uniform(0.85, 0.97)
    shade = plain(rng.uniform(0.05, 0.8))
    return Surface(pose, reach * card.width_m, reach * card.width_m, shade, 0.3)


def _truth(
    scene: _Scene, card: tuple[int, int], arrays: SurfaceArrays, illumination: Any, gain: float
) -> MarkerTruth:
    which, marker_id = card
    camera, known = scene.camera, (scene.dictionary.name, marker_id, _MARKER_M)
    truth = marker_truth(camera, scene.surfaces, which, known, arrays)
    middle = np.rint(camera.project(truth.camera_from_marker[:3, 3])).astype(int)
    u, v = np.clip(middle, 0, [camera.width - 1, camera.height - 1])
    light = float(illumination[v, u]) if np.ndim(illumination) == 2 else 1.0
    return replace(truth, contrast_grey=gain * light * (WHITE - BLACK))


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(np.log(bounds[0]), np.log(bounds[1]))))


def write_samples(
    settings: SampleSettings, folder: Path, *, count: int, seed: int, jobs: int = 1,
    overwrite: bool = False,
) -> int:  # fmt: skip
    """Render random frames and write them as PNG files, with their calibrations and truth."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    cameras = sample_cameras(settings.width, settings.height)
    for number, camera in enumerate(cameras):
        write_camera(camera, folder / f"camera{number}.cam", overwrite=overwrite)
    names = {format_camera(camera): f"camera{k}.cam" for k, camera in enumerate(cameras)}
    rows: list[dict[str, Any]] = []
    for frame in in_order(partial(sample_frame, settings, seed), range(count), jobs):
        prefix = f"s{seed}.{frame.index:05d}"
        png = encoded(frame.image, ".png")
        write_bytes(folder / "images" / f"{prefix}.png", png, overwrite=overwrite)
        row = {"image": prefix, "camera": names[format_camera(frame.camera)]}
        rows.append({**row, **frame.as_json()})
    head = {"settings": {**asdict(settings), "photographs": None}}
    write_truth(folder / "truth.json", head, {"frames": rows}, overwrite=overwrite)
    return sum(len(row["markers"]) for row in rows)
