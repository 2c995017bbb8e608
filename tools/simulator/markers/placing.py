"""Where things go in random frames: places in the image, poses in space, boxes behind them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from camera import Camera
from tools.simulator.markers.clutter import blotches
from tools.simulator.markers.surface import (
    FloatArray,
    Surface,
    Texture,
    box_sides,
    cross,
    plain,
)
from tools.simulator.markers.truth import marker_corners, mean_side_px

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
    """Find a place in the image that nothing has taken.

    Parameters
    ----------
    rng : numpy Generator
        Source of chance.
    camera : Camera
        The camera.
    taken : sequence of Placed
        What has its place already.
    width_px : float
        Of the new thing.
    inside : bool
        Whether it must lie in the image as a whole.

    Returns
    -------
    Placed or None
        None if there was no room at some random places.
    """
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
    across = cross(toward, np.array([0.0, 1.0, 0.0]))
    across /= np.linalg.norm(across)
    upward = cross(toward, across)
    direction = rng.uniform(0.0, 2.0 * np.pi)
    sideways = np.cos(direction) * across + np.sin(direction) * upward
    slant = np.radians(slant_deg)
    normal = np.cos(slant) * toward + np.sin(slant) * sideways
    turn = rng.uniform(0.0, 2.0 * np.pi)
    other = cross(normal, toward if slant > 0.1 else across)
    other /= np.linalg.norm(other)
    x = np.cos(turn) * other + np.sin(turn) * cross(normal, other)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = x, cross(normal, x), normal
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
    # The box's own frame has its front at +x and stands on z = 0.
    card_from_box = np.eye(4)
    card_from_box[:3, :3] = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    card_from_box[:3, 3] = [shift[0], shift[1] - 0.5 * upward, -0.5 * depth - _BEHIND_M]
    shade = rng.uniform(0.08, 0.85)
    textures: dict[str, Texture] = {
        side: plain(float(np.clip(shade * rng.uniform(0.5, 1.2), 0.03, 0.95)))
        for side in ("front", "left", "right", "top")
    }
    if rng.random() < 0.4:
        pattern = shade + 0.25 * (blotches(rng, (48, 64), octaves=3) - np.float32(0.5))
        textures["front"] = Texture(np.clip(pattern, 0.03, 0.95).astype(np.float32), smooth=True)
    return box_sides((depth, across, upward), textures, card.pose @ card_from_box)
