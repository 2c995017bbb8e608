"""Images with a chosen number of landmarks: discs on a bare floor, stripes on a bare wall."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from tools.benchmark.errors import BenchmarkError
from tools.simulator.single_disc import render_disc

FloatArray = NDArray[np.float64]

_FLOOR, _DISC = 90.0, 200.0
_DARK, _LIGHT = 90.0, 160.0
_BLUR_PX = 0.7
_NOISE = 1.5
_RADIUS_M = 0.10

#: Discs lie this far apart at least, this far away at most, and this far inside the image.
_APART_M = 0.35
_FARTHEST_M = 4.0
_MARGIN_PX = 30

#: Attempts to place a disc.
_ATTEMPTS = 10_000

#: Samples per pixel and axis of a wall, and the wall's stripes' part of the view.
_FINE = 4
_WALL_SHARE = 0.8


def disc_places(camera: Camera, count: int, seed: int) -> FloatArray:
    """Floor positions of discs that the camera sees whole, none near another.

    The first of more are the same as fewer.

    Parameters
    ----------
    camera : Camera
    count : int
        How many.
    seed : int
        Of the places.

    Returns
    -------
    (count, 2) float64
        Robot frame, metres.

    Raises
    ------
    BenchmarkError
        If so many find no room.
    """
    rng = np.random.default_rng(seed)
    low = np.full(2, float(_MARGIN_PX))
    high = np.array([camera.width, camera.height]) - 1.0 - _MARGIN_PX
    places = np.zeros((0, 2))
    for _ in range(_ATTEMPTS):
        if len(places) == count:
            return places
        place = camera.floor_from_pixel(rng.uniform(low, high))
        near = float(np.hypot(*place)) <= _FARTHEST_M  # false for NaN, above the horizon
        if near and np.all(np.hypot(*(places - place).T) >= _APART_M):
            places = np.vstack([places, place])
    raise BenchmarkError(f"{count} discs do not find room on the floor: expected fewer")


def floor_with_discs(camera: Camera, places: FloatArray, seed: int) -> NDArray[np.uint8]:
    """A bare floor with light discs, blurred and noisy.

    Parameters
    ----------
    camera : Camera
    places : (N, 2) float64
        Where the discs lie, robot frame, metres.
    seed : int
        Of the noise.

    Returns
    -------
    (H, W) uint8
    """
    grey = np.full((camera.height, camera.width), _FLOOR)
    for place in places:
        crop = render_disc(camera, place, _RADIUS_M, _DISC, _FLOOR, _BLUR_PX, rounded=False)
        height, width = crop.grey.shape
        grey[crop.v0 : crop.v0 + height, crop.u0 : crop.u0 + width] += crop.grey - _FLOOR
    return _taken(grey, seed)


def wall_with_edges(camera: Camera, count: int, seed: int) -> NDArray[np.uint8]:
    """A wall all round, striped so that the camera sees a number of vertical edges.

    Parameters
    ----------
    camera : Camera
    count : int
        Edges, equally spaced in bearing over most of the view.
    seed : int
        Of the noise.

    Returns
    -------
    (H, W) uint8
    """
    fine = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    u = (np.arange(camera.width)[:, None] + fine).ravel()
    v = (np.arange(camera.height)[:, None] + fine).ravel()
    direction = camera.directions_robot(np.stack(np.meshgrid(u, v), axis=-1))
    bearing = np.arctan2(direction[..., 0], -direction[..., 1])
    middle = bearing[len(v) // 2]
    half = 0.5 * _WALL_SHARE * (float(np.max(middle)) - float(np.min(middle)))
    centre = 0.5 * (float(np.max(middle)) + float(np.min(middle)))
    edges = centre + half * (2.0 * (np.arange(count) + 0.5) / max(count, 1) - 1.0)
    light = np.searchsorted(edges, bearing) % 2 == 1
    share = light.reshape(camera.height, _FINE, camera.width, _FINE).mean(axis=(1, 3))
    return _taken(_DARK + (_LIGHT - _DARK) * share, seed)


def _taken(grey: FloatArray, seed: int) -> NDArray[np.uint8]:
    """Grey values with the noise of a sensor, rounded."""
    noisy = grey + np.random.default_rng(seed).normal(0.0, _NOISE, grey.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)
