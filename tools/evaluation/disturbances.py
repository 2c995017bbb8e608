"""Discs of real images, disturbed as the floors of buildings disturb them, with known places."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: A disturbed disc is used if this share of its rim is not hidden, and as much still steps by so
#: many grey levels.
_LEAST_RIM = 0.62
_LEAST_STEP = 8.0
#: How far out an image is changed, radii.
_REACH = 6.0


class _Place:
    """Grey values about a disc, and where they lie: `s` and `t` in radii, `s` in some direction."""

    def __init__(self, grey: FloatArray, offset: FloatArray, rng: np.random.Generator) -> None:
        turn = rng.uniform(0.0, 2.0 * np.pi)
        self.grey, self.rng = grey, rng
        self.s = offset @ [np.cos(turn), np.sin(turn)]
        self.t = offset @ [-np.sin(turn), np.cos(turn)]
        self.radius = np.hypot(self.s, self.t)
        pixels = max(np.sqrt((self.radius < 1.0).sum() / np.pi), 1.0)
        self._softest = 0.3 / pixels
        self.disc = float(np.median(grey[self.radius < 1.0]))
        self.floor = float(np.median(grey[(self.radius > 1.2) & (self.radius < 1.7)]))

    def side(self, beyond: FloatArray, width: float = 0.05) -> FloatArray:
        """1 where something is above 0, 0 where below; softly."""
        shares = 1.0 / (1.0 + np.exp(-np.clip(beyond / max(width, self._softest), -30.0, 30.0)))
        return np.asarray(shares)

    def cover(self, share: FloatArray, grey: float) -> tuple[FloatArray, NDArray[np.bool_]]:
        return self.grey * (1.0 - share) + share * grey, share > 0.5


_Disturbed = tuple[FloatArray, NDArray[np.bool_]]


def _sun_patch(p: _Place) -> _Disturbed:
    lit = p.side(p.s - p.rng.uniform(0.3, 1.2)) * p.side(p.t + p.rng.uniform(0.3, 6.0))
    return p.grey * (1.0 + lit * p.rng.uniform(0.5, 3.0)), p.radius < 0.0


def _shadow(p: _Place) -> _Disturbed:
    dark = p.side(p.s - p.rng.uniform(-0.3, 1.0), p.rng.uniform(0.05, 0.4))
    return p.grey * (1.0 - dark * p.rng.uniform(0.3, 0.7)), p.radius < 0.0


def _glare(p: _Place) -> _Disturbed:
    width = p.rng.uniform(0.1, 0.8)
    lit = p.side(p.s - p.rng.uniform(-0.2, 1.8), width)
    lifted = p.rng.uniform(0.0, 0.5) * lit
    grey = (p.grey + lit * p.rng.uniform(30.0, 180.0)) * (1.0 - lifted) + 255.0 * lifted
    return grey, p.radius < 0.0


def _cable(p: _Place) -> _Disturbed:
    middle = p.rng.uniform(-0.8, 0.8) + p.rng.uniform(-0.2, 0.2) * p.t**2
    share = p.side(p.rng.uniform(0.06, 0.2) - np.abs(p.s - middle), 0.03)
    return p.cover(share, p.rng.uniform(0.0, 60.0))


def _stain(p: _Place) -> _Disturbed:
    share = p.side(p.rng.uniform(0.2, 0.55) - np.hypot(p.s - p.rng.uniform(0.0, 1.1), p.t))
    return p.cover(share, p.rng.uniform(0.2, 0.8) * p.disc)


def _paper(p: _Place) -> _Disturbed:
    near, half = p.rng.uniform(0.75, 1.1), p.rng.uniform(0.5, 2.0)
    share = p.side(p.s - near) * p.side(near + p.rng.uniform(0.8, 2.5) - p.s)
    share = share * p.side(half - np.abs(p.t - p.rng.uniform(-1.0, 1.0)))
    return p.cover(share, p.disc + p.rng.uniform(-0.3, 0.6) * (p.disc - p.floor))


def _edge(p: _Place) -> _Disturbed:
    return p.cover(p.side(p.s - p.rng.uniform(0.25, 0.95), 0.03), p.rng.uniform(0.0, 255.0))


def _leg(p: _Place) -> _Disturbed:
    share = p.side(p.rng.uniform(0.1, 0.3) - np.abs(p.s - p.rng.uniform(-0.9, 0.9)), 0.03)
    return p.cover(share, float(p.rng.choice([30.0, 200.0])))


DISTURBANCES: dict[str, Callable[[_Place], _Disturbed]] = {
    "sun patch": _sun_patch,
    "shadow": _shadow,
    "glare": _glare,
    "cable": _cable,
    "stain": _stain,
    "paper": _paper,
    "edge": _edge,
    "leg": _leg,
}


LOOK_ALIKES = ("square", "ring", "oval", "saucer", "plate")


def _look_alike(p: _Place, kind: str) -> FloatArray:
    """The floor with something else of the disc's grey value in the disc's place."""
    width, height = p.rng.uniform([0.75, 0.75], [1.25, 1.25])
    share = {
        "square": p.side(width - np.abs(p.s)) * p.side(height - np.abs(p.t)),
        "ring": p.side(1.0 - p.radius) * p.side(p.radius - p.rng.uniform(0.3, 0.85)),
        "oval": p.side(1.0 - np.hypot(p.s / (0.7 * width), p.t / (1.2 * height))),
        "saucer": p.side(p.rng.uniform(0.45, 0.75) - p.radius),
        "plate": p.side(p.rng.uniform(1.3, 1.7) - p.radius),
    }[kind]
    bare = np.where(p.radius < 1.15, p.floor, p.grey)
    return np.asarray(bare * (1.0 - share) + share * p.disc)


def replaced(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    place: FloatArray,
    radius: float,
    kind: str,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """An image with one of `LOOK_ALIKES` instead of a disc; parameters as of `disturbed`."""
    window, p = _surroundings(image, floor_xy, place, radius, rng)
    return _with(image, window, p, _look_alike(p, kind))


_Window = tuple[slice, slice]


def _surroundings(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    place: FloatArray,
    radius: float,
    rng: np.random.Generator,
) -> tuple[_Window, _Place]:
    offset = (floor_xy - place.astype(np.float32)) / np.float32(radius)
    rows, columns = np.nonzero(np.hypot(offset[..., 0], offset[..., 1]) < _REACH)
    window = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    return window, _Place(image[window].astype(np.float64), offset[window].astype(np.float64), rng)


def _with(
    image: NDArray[np.uint8], window: _Window, p: _Place, grey: FloatArray
) -> NDArray[np.uint8]:
    """An image with other grey values about a disc, and noise where they are others."""
    changed = np.abs(grey - p.grey) > 1.0
    noisy = grey + changed * p.rng.normal(0.0, 0.8, grey.shape)
    result = image.copy()
    result[window] = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    return result


def disturbed(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    place: FloatArray,
    radius: float,
    kind: str,
    rng: np.random.Generator,
) -> NDArray[np.uint8] | None:
    """An image with one light disc disturbed.

    Parameters
    ----------
    image : (H, W) uint8
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    place : (2,) float64
        The disc's, metres.
    radius : float
        Metres.
    kind : str
        Of `DISTURBANCES`.
    rng : numpy.random.Generator

    Returns
    -------
    (H, W) uint8 or None
        None where too little of the disc is left to be seen.
    """
    window, p = _surroundings(image, floor_xy, place, radius, rng)
    grey, hidden = DISTURBANCES[kind](p)
    result = _with(image, window, p, grey)
    seen = 0
    angles = 2.0 * np.pi * np.arange(32) / 32
    for angle in angles:
        at = [
            np.hypot(p.s - r * np.cos(angle), p.t - r * np.sin(angle)).argmin()
            for r in (0.75, 1.0, 1.3)
        ]
        inside, _, outside = (float(result[window].flat[i]) for i in at)
        seen += inside - outside > _LEAST_STEP and not hidden.flat[at[1]]
    return result if seen >= _LEAST_RIM * len(angles) else None
