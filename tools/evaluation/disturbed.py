"""Discs that are partly hidden, stained, badly lit or blurred, rendered with exact truth.

A scene is a floor (carpet, tiles, parquet, lino) with some discs or look-alikes on it, computed on
a grid finer than the pixels, seen through a calibrated camera: its optics blur, its pixels average,
its noise and JPEG follow. Each family of disturbances is measured at several shares of the rim.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from camera import Camera, read_camera
from detect.circles import CircleDetections, detect_circles, disc_table
from detect.settings import CircleSettings
from redetect.array_types import ByteArray, FloatArray
from redetect.landmarks import squared_mahalanobis
from redetect.storage import write_bytes
from tools.evaluation.disturbances import DISTURBANCES, LOOK_ALIKES, REACH, Surroundings, look_alike
from tools.evaluation.figures import Figures, Study, StudyError, demand_some
from tools.evaluation.tables import Table
from tools.simulator.files import encoded
from tools.simulator.pixels import noisy_image, subpixel_grid

FLOORS = ("carpet", "tiles", "parquet", "lino")
#: Families without a share of the rim, and what blurs the image: motion along u and optics, pixels.
BLURRED = {
    "motion blur 5 px": (5.0, 0.7),
    "motion blur 10 px": (10.0, 0.7),
    "motion blur 15 px": (15.0, 0.7),
    "defocus 2 px": (0.0, 2.0),
    "defocus 3 px": (0.0, 3.0),
}
BORDER = "cut by the border"
_OPTICS = (0.0, 0.7)
#: Cells per pixel along u and v, on which scenes are computed.
_FINE = (3, 4)
_NEAREST_M, _FARTHEST_M = 0.8, 4.0
_APART_M = 1.2
_PER_SCENE = 4
_NOISE = 2.5
_JPEG = 88
#: A row this near a disc has found it, radii.
_GATE = 0.6
#: So many images of one kind, one after the other, may be without a disc.
_MOST_EMPTY = 5
#: A rim outside the image may have this much more or less of a share than asked for.
_SLACK = 0.05


@dataclass
class Tally:
    """What became of the discs, or look-alikes, of one kind."""

    shown: int = 0
    found: int = 0
    error_px: list[FloatArray] = field(default_factory=list)  # Found less true place, in the image.
    normalised: list[float] = field(default_factory=list)
    """Squared error on the floor over the stated covariance, per degree of freedom."""
    elsewhere: int = 0  # Rows at no disc.

    @property
    def recall(self) -> float:
        """Share of those shown that were found."""
        return self.found / max(self.shown, 1)

    @property
    def rms_px(self) -> float:
        """Root mean square of the errors of either coordinate, pixels."""
        return float(np.sqrt(np.mean(np.square(self.error_px)))) if self.error_px else np.nan

    @property
    def normalised_error(self) -> float:
        """Mean normalised error squared per degree of freedom."""
        return float(np.mean(self.normalised)) if self.normalised else np.nan


class FloorScene:
    """A camera over its floors, on the fine grid, and how far away discs may be."""

    def __init__(
        self, camera: Camera, radius_m: float, rng: np.random.Generator,
        farthest_m: float = _FARTHEST_M,
    ) -> None:  # fmt: skip
        self.camera, self.radius_m, self.farthest_m = camera, radius_m, farthest_m
        self.floor_xy = camera.floor_from_pixel(subpixel_grid(camera, *_FINE))
        self.floors = {kind: _texture(kind, self.floor_xy, rng) for kind in FLOORS}

    def outline(self, place: FloatArray, radii: float = 1.0) -> FloatArray:
        """(64, 2) pixels of a circle about a place."""
        angle = 2.0 * np.pi * np.arange(64) / 64
        circle = radii * self.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return self.camera.project_floor(place + circle)

    def seen_share(self, place: FloatArray, radii: float = 1.0) -> float:
        """How much of a circle is in the image."""
        u, v = self.outline(place, radii).T
        inside = (u > -0.5) & (u < self.camera.width - 0.5)
        return float(np.mean(inside & (v > -0.5) & (v < self.camera.height - 0.5)))

    def window(self, place: FloatArray) -> tuple[slice, slice]:
        """The cells within reach of a disturbance."""
        outline = self.outline(place, REACH)
        outline = outline[np.isfinite(outline).all(axis=-1)]
        across, down = _FINE
        low = np.maximum(np.floor(outline.min(axis=0)), 0.0).astype(int)
        high = np.ceil(outline.max(axis=0)).astype(int) + 1
        return slice(low[1] * down, high[1] * down), slice(low[0] * across, high[0] * across)

    def exposed(
        self, grey: FloatArray, blur: tuple[float, float], rng: np.random.Generator
    ) -> ByteArray:
        """An image of a fine scene, with motion and optics that blur by so many pixels."""
        across, down = _FINE
        motion, optics = blur
        fine: NDArray[Any] = grey.astype(np.float32)
        along_v = optics * self.camera.scale_y / self.camera.scale_x
        fine = cv2.GaussianBlur(fine, (0, 0), optics * across, sigmaY=max(along_v * down, 0.3))
        if motion > 0.0:
            # An even number of cells would move everything by half of one.
            fine = cv2.blur(fine, (2 * (round(motion * across) // 2) + 1, 1))
        size = self.camera.width, self.camera.height
        pixels = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
        noisy = noisy_image(np.asarray(pixels, np.float64), _NOISE, rng)
        _, jpeg = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, _JPEG])
        return np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE), np.uint8)


def _texture(kind: str, floor_xy: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Grey values of a floor."""
    x, y = np.nan_to_num(floor_xy[..., 0]), np.nan_to_num(floor_xy[..., 1])
    mottled = np.zeros_like(x)
    for wave in 2.0 * np.pi / np.array([0.9, 0.5, 0.31]):
        turn, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        mottled += np.sin(wave * (x * np.cos(turn) + y * np.sin(turn)) + phase)
    if kind == "carpet":
        cells = (np.floor(x / 0.006) * 73856093).astype(int) ^ (
            np.floor(y / 0.006) * 19349663
        ).astype(int)
        return np.asarray(70.0 + 3.0 * mottled + 30.0 * rng.uniform(-1.0, 1.0, 4096)[cells % 4096])
    if kind == "tiles":
        column, row = np.floor(x / 0.3).astype(int), np.floor(y / 0.3).astype(int)
        shade = rng.uniform(-8.0, 8.0, 97)[(column * 31 + row * 17) % 97]
        joint = (np.mod(x, 0.3) < 0.006) | (np.mod(y, 0.3) < 0.006)
        return np.asarray(np.where(joint, 55.0, 100.0 + shade + mottled))
    if kind == "parquet":
        strip = np.floor(x / 0.07).astype(int)
        board = np.floor(y / 0.5 + 0.37 * strip).astype(int)
        shade = rng.uniform(-18.0, 18.0, 101)[(strip * 13 + board * 29) % 101]
        return np.asarray(85.0 + shade + 4.0 * np.sin(2.0 * np.pi * x / 0.011) + mottled)
    return np.asarray(60.0 + 5.0 * mottled)


def _places(scene: FloorScene, outside: float, rng: np.random.Generator) -> list[FloatArray]:
    """Places of discs apart from each other, with a share of the rim outside the image."""
    places: list[FloatArray] = []
    width, height = scene.camera.width, scene.camera.height
    for _ in range(4000):
        pixel = rng.uniform([-40.0, 0.0], [width + 40.0, height + 40.0])
        ahead = scene.camera.floor_from_pixel(pixel)
        distance = rng.uniform(_NEAREST_M, scene.farthest_m)
        place = ahead * distance / np.hypot(*ahead)
        if not np.isfinite(place).all():
            continue
        if outside > 0.0:
            fits = abs(1.0 - scene.seen_share(place) - outside) < _SLACK
            fits = fits and scene.seen_share(place, 0.0) == 1.0
        else:
            fits = scene.seen_share(place, 1.6) == 1.0
        if fits and all(np.hypot(*(place - other)) > _APART_M for other in places):
            places.append(place)
            if len(places) == _PER_SCENE:
                break
    return places


def render_scene(
    scene: FloorScene, kind: str, share: float, rng: np.random.Generator
) -> tuple[ByteArray, list[FloatArray]]:
    """(H, W) image of a floor with discs of one family of disturbances, or look-alikes."""
    grey = scene.floors[str(rng.choice(list(scene.floors)))].copy()
    places = _places(scene, share if kind == BORDER else 0.0, rng)
    for place in places:
        window = scene.window(place)
        offset = (scene.floor_xy[window] - place) / scene.radius_m
        light = rng.uniform(170.0, 235.0)
        grey[window] = np.where(np.hypot(*np.moveaxis(offset, -1, 0)) < 1.0, light, grey[window])
        away = place - scene.camera.centre[:2]
        about = Surroundings.of(grey[window], offset, float(np.arctan2(away[1], away[0])))
        if kind in LOOK_ALIKES:
            grey[window] = look_alike(about, kind, rng)
        elif kind in DISTURBANCES and share > 0.0:
            grey[window] = np.clip(DISTURBANCES[kind](about, share, rng), 0.0, 255.0)
    return scene.exposed(grey, BLURRED.get(kind, _OPTICS), rng), places


def measure_families(
    camera: Camera, settings: CircleSettings, *, discs: int, shares: Sequence[float], seed: int
) -> Iterator[tuple[str, float, Tally]]:
    """Detect the discs of scenes of every family and share, and the look-alikes."""
    scene = FloorScene(camera, settings.radius_m, np.random.default_rng(seed))
    table = disc_table(camera, settings)
    cases = [(kind, share) for kind in (*DISTURBANCES, BORDER) for share in shares]
    cases += [(kind, 0.0) for kind in (*BLURRED, *LOOK_ALIKES)]
    for number, (kind, share) in enumerate(cases):
        rng = np.random.default_rng([seed, number])
        tally, empty = Tally(), 0
        while tally.shown < discs:
            image, places = render_scene(scene, kind, share, rng)
            empty = 0 if places else empty + 1
            if empty == _MOST_EMPTY:
                raise StudyError(f"{kind}: {empty} images without a disc: expected room for some")
            found = detect_circles(image, camera, table, settings)
            count_found(tally, camera, found, places, settings.radius_m)
        yield kind, share, tally


def count_found(
    tally: Tally, camera: Camera, found: CircleDetections, places: list[FloatArray], radius: float
) -> None:
    """Count the discs at some places that were found, with their errors, and rows elsewhere."""
    taken = np.zeros(len(found), np.bool_)
    for place in places:
        tally.shown += 1
        off = found.floor_xy - place
        distance = np.hypot(off[:, 0], off[:, 1])
        taken |= distance < REACH * radius
        if not (distance < _GATE * radius).any():
            continue
        nearest = int(np.argmin(distance))
        tally.found += 1
        seen, true = camera.project_floor(np.stack([found.floor_xy[nearest], place]))
        tally.error_px.append(seen - true)
        squared = squared_mahalanobis(off[nearest], found.covariance[nearest])
        tally.normalised.append(float(squared) / 2.0)
    tally.elsewhere += int((~taken).sum())


def picture_of(camera: Camera, radius_m: float, share: float, seed: int) -> ByteArray:
    """One disc of every family and one of every look-alike, side by side with their names."""
    scene = FloorScene(camera, radius_m, np.random.default_rng(seed))
    panels = []
    for number, kind in enumerate((*DISTURBANCES, BORDER, *BLURRED, *LOOK_ALIKES)):
        rng = np.random.default_rng([seed, number])
        image, places = render_scene(scene, kind, share, rng)
        demand_some(places, f"{kind}: discs in the image")
        place = min(places, key=lambda at: abs(float(np.hypot(*at)) - 1.8))
        panels.append(_panel(image, scene.outline(place, 2.5), kind))
    columns = 6
    panels += [np.full_like(panels[0], 255)] * (-len(panels) % columns)
    rows = [np.hstack(panels[k : k + columns]) for k in range(0, len(panels), columns)]
    return np.vstack(rows)


def _panel(image: ByteArray, outline: FloatArray, name: str) -> ByteArray:
    middle = outline.mean(axis=0)
    half = float(np.ptp(outline[:, 0])) / 2.0
    rows = np.linspace(middle[1] - half / 2.0, middle[1] + half / 2.0, 160)
    columns = np.linspace(middle[0] - half, middle[0] + half, 160)
    u, v = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    panel = np.full((190, 168), 255, np.uint8)
    panel[26:186, 4:164] = cv2.remap(image, u, v, cv2.INTER_NEAREST, borderValue=255)
    cv2.putText(panel, name, (4, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 0, 1, cv2.LINE_AA)
    return panel


@dataclass(frozen=True)
class Disturbed(Study):
    """Detect rendered look-alikes, and discs partly hidden, stained, badly lit or blurred."""

    camera: Path = Path("images/e/e.cam")  # Calibration for rendering and detection.
    discs: int = 100  # Discs of each family and share.
    shares: tuple[float, ...] = (0.2, 0.3, 0.4)  # Disturbed shares of the rim.
    polarity: Literal["light", "any"] = "light"  # Given to the detector; the discs are light.
    seed: int = 2  # Of scenes and noise; the training of the network begins with 1.
    picture: Path | None = None  # Only draw one disc of each family, without detection.

    def measure(self) -> Figures:
        camera = read_camera(self.camera)
        settings = CircleSettings(polarity=self.polarity, tilt_sigma_deg=0.0)
        if self.picture is not None:
            drawn = picture_of(camera, settings.radius_m, self.shares[-1], self.seed)
            write_bytes(self.picture, encoded(drawn, ".png"), overwrite=True)
            return {}
        table = Table(
            {"family": "<18", "share %": ".0f", "shown": "d", "found": ".3f", "rms px": ".2f",
             "normalised": ".2f", "elsewhere": "d"}, keys=2
        )  # fmt: skip
        results = measure_families(
            camera, settings, discs=self.discs, shares=self.shares, seed=self.seed
        )
        for kind, share, t in results:
            table.row(kind, 100.0 * share, t.shown, t.recall, t.rms_px, t.normalised_error,
                      t.elsewhere)  # fmt: skip
        return table.figures
