"""Images of a floor with discs, and with what is no disc, at places that are known exactly."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera import Camera
from camera.uncertainty import with_pose
from tools.evaluation.boards import rays_of
from tools.simulator.single_disc import DiscCrop, render_disc

FLOOR = 90.0
LIGHT = 200.0
DARK = 25.0
#: Of a door or a cupboard before a disc.
DOOR = 140.0

FloatArray = NDArray[np.float64]
#: Which offsets (x, y), in metres, are inside.
Shape = Callable[[FloatArray, FloatArray], NDArray[np.bool_]]

#: What is no disc of 0.1 m.
SHAPES: dict[str, Shape] = {
    "square": lambda x, y: np.asarray(np.maximum(abs(x), abs(y)) < 0.10),
    "ring": lambda x, y: np.asarray(abs(np.hypot(x, y) - 0.085) < 0.015),
    "triangle": lambda x, y: np.asarray((y > -0.10) & (y < 0.10 - 2.0 * abs(x))),
    "large disc": lambda x, y: np.asarray(np.hypot(x, y) < 0.14),
    "small disc": lambda x, y: np.asarray(np.hypot(x, y) < 0.07),
    "strip": lambda x, y: np.asarray((abs(x) < 0.07) & (abs(y) < 0.25)),
    "corner": lambda x, y: np.asarray((x > -0.1) & (y > -0.1)),
}

_CELLS_PER_PIXEL = 6
_REACH_M = 0.3
# Most tests have one lens.
_rays_of = lru_cache(maxsize=1)(rays_of)


class PaintedFloor:
    """A bare floor; what is painted adds to it, the image is taken at the end."""

    def __init__(self, camera: Camera, floor: float = FLOOR) -> None:
        self.camera = camera
        self.floor = floor
        self.grey: FloatArray = np.full((camera.height, camera.width), floor)

    def disc(
        self, floor_xy: ArrayLike, grey: float = LIGHT, radius_m: float = 0.10, blur_px: float = 0.7
    ) -> PaintedFloor:
        x, y = np.asarray(floor_xy, np.float64).tolist()
        crop = _rendered(self.camera, (x, y), radius_m, grey, self.floor, blur_px)
        self.grey[crop.window] += crop.grey - self.floor
        return self

    def shape(self, floor_xy: ArrayLike, inside: Shape, grey: float = LIGHT) -> PaintedFloor:
        """Anything within 0.3 m, given by which offsets (x, y) in metres are inside."""
        n = _CELLS_PER_PIXEL
        angle = np.linspace(0.0, 2.0 * np.pi, 64)
        around = np.asarray(floor_xy) + _REACH_M * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        seen = self.camera.project_floor(around)
        u0, v0 = np.maximum(np.floor(seen.min(axis=0)).astype(int), 0)
        size = (self.camera.width, self.camera.height)
        u1, v1 = np.minimum(np.ceil(seen.max(axis=0)).astype(int) + 1, size)
        fine = (np.arange(n) + 0.5) / n - 0.5
        u = (np.arange(u0, u1)[:, None] + fine).ravel()
        v = (np.arange(v0, v1)[:, None] + fine).ravel()
        uv = np.stack(np.meshgrid(u, v), axis=-1)
        offset = self.camera.floor_from_pixel(uv) - np.asarray(floor_xy)
        cells = inside(offset[..., 0], offset[..., 1])
        share = cells.reshape(v1 - v0, n, u1 - u0, n).mean(axis=(1, 3))
        self.grey[v0:v1, u0:u1] += (grey - self.floor) * share
        return self

    def door(self, floor_xy: ArrayLike, share: float, radius_m: float = 0.10) -> PaintedFloor:
        """Hide what lies to the right of a share of a disc's radius from its middle."""
        place = np.asarray(floor_xy)
        u, _ = self.camera.project_floor(place)
        ends = place + np.array([[-radius_m, 0.0], [radius_m, 0.0]])
        left, right = self.camera.project_floor(ends)[:, 0]
        first = round(u + share * abs(right - left) / 2.0)
        self.grey[:, first : first + 80] = DOOR
        return self

    def wall(self, distance_m: float = 12.0, panel_deg: float = 5.0) -> PaintedFloor:
        """A round wall about the camera, of light and dark panels: their edges are vertical."""
        n, (height, width) = 4, self.grey.shape
        ray_xy = _rays_of(with_pose(self.camera, np.eye(3, 4)), n).xy
        rotation = self.camera.rotation
        x, y, z = np.moveaxis(ray_xy @ rotation[:, :2].T + rotation[:, 2], -1, 0)
        on_wall = distance_m * z > -self.camera.centre[2] * np.hypot(x, y)
        panel = np.floor(np.degrees(np.arctan2(x, -y)) / panel_deg) % 2
        grey = np.where(on_wall, DOOR - 50.0 * panel, np.nan).reshape(height, n, width, n)
        share = np.isfinite(grey).mean(axis=(1, 3))
        self.grey = (1.0 - share) * self.grey + np.nan_to_num(grey).mean(axis=(1, 3))
        return self

    def image(self, noise: float = 1.5, seed: int = 0) -> NDArray[np.uint8]:
        noisy = self.grey + np.random.default_rng(seed).normal(0.0, noise, self.grey.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@lru_cache(maxsize=256)
def _rendered(
    camera: Camera, floor_xy: tuple[float, float], radius_m: float, grey: float, floor: float,
    blur_px: float,
) -> DiscCrop:  # fmt: skip
    """Half of all discs of the tests are painted more than once."""
    return render_disc(camera, floor_xy, radius_m, grey, floor, blur_px)
