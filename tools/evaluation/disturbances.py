"""What dirt, light and furniture do to the picture of a disc on the floor, and what resembles one.

Everything happens on the floor round one disc, in units of its radius. A disturbance is a shape,
whose size follows from the share of the rim that is to lie under it, and what it does to the grey
values there. The same functions change real images (`disturbed`, `replaced`: for training) and the
supersampled scenes of `tools.evaluation.disturbed`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from redetect.array_types import ByteArray, Float32Array, FloatArray

#: Signed distance into a shape of some size, radii, at places (s, t).
Distance = Callable[[FloatArray, FloatArray, float], FloatArray]

#: How far out an image is changed, radii.
REACH = 6.0
#: Shares of the rim that are disturbed for training.
_SHARES = (0.05, 0.45)
_RIM = 2.0 * np.pi * np.arange(256) / 256


@dataclass(frozen=True)
class Surroundings:
    """Grey values about a light disc."""

    grey: FloatArray  # (H, W)
    offset: FloatArray  # (H, W, 2) Floor position less the disc's centre, radii.
    away: float  # Direction from the camera to the disc on the floor, radians.
    disc: float  # Grey values of the two.
    floor: float
    pixel: float  # Size of a pixel, radii: nothing is sharper.

    @classmethod
    def of(cls, grey: FloatArray, offset: FloatArray, away: float) -> Surroundings:
        """Measure the grey values of disc and floor."""
        radius = np.hypot(offset[..., 0], offset[..., 1])
        return cls(
            grey, offset, away,
            disc=float(np.median(grey[radius < 0.9])),
            floor=float(np.median(grey[(radius > 1.2) & (radius < 1.7)])),
            pixel=1.0 / max(np.sqrt((radius < 1.0).sum() / np.pi), 1.0),
        )  # fmt: skip

    def turned(self, turn: float) -> tuple[FloatArray, FloatArray]:
        """Coordinates (s, t) whose t axis has a direction `turn`."""
        x, y = self.offset[..., 0], self.offset[..., 1]
        return x * np.sin(turn) - y * np.cos(turn), x * np.cos(turn) + y * np.sin(turn)

    def share(self, distance: FloatArray, width: float) -> FloatArray:
        """1 inside a shape, 0 outside, over an edge of some width (radii)."""
        scaled = distance / max(width, 0.3 * self.pixel)
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(scaled, -30.0, 30.0))))


# --- Shapes ------------------------------------------------------------------------------------


def _half_plane(rng: np.random.Generator) -> Distance:
    return lambda s, t, size: s - (1.0 - size)


def _cables(rng: np.random.Generator) -> Distance:
    middle, bend = rng.uniform(-0.6, 0.6), rng.uniform(-0.2, 0.2)

    def distance(s: FloatArray, t: FloatArray, size: float) -> FloatArray:
        across = s - middle - bend * t**2
        # One cable is at most 0.2 radii thick; more of the rim is under several, to either side.
        places = 0.3 * np.array([(k + 1) // 2 * (-1) ** k for k in range(math.ceil(size / 0.1))])
        inside = [
            min(size - 0.1 * k, 0.1) - np.abs(across - place) for k, place in enumerate(places)
        ]
        return np.asarray(np.max(inside, axis=0) if inside else np.full_like(across, -1.0))

    return distance


def _band(rng: np.random.Generator) -> Distance:
    middle = rng.uniform(-0.8, 0.8)
    return lambda s, t, size: size - np.abs(s - middle)


def _upright_band(rng: np.random.Generator) -> Distance:
    middle, foot = rng.uniform(-0.9, 0.9), rng.uniform(-1.5, -0.8)
    return lambda s, t, size: np.minimum(size - np.abs(s - middle), t - foot)


def _sheet(rng: np.random.Generator) -> Distance:
    half, depth = rng.uniform(1.2, 1.6), rng.uniform(2.0, 2.5)
    middle = rng.uniform(-0.3, 0.3)
    return lambda s, t, size: np.minimum(
        np.minimum(s - (1.0 - size), 1.0 - size + depth - s), half - np.abs(t - middle)
    )


def _blot(rng: np.random.Generator) -> Distance:
    middle = rng.uniform(0.7, 1.1)
    return lambda s, t, size: size - np.hypot(s - middle, t)


def _blots(rng: np.random.Generator) -> Distance:
    angle, out = rng.uniform(0.0, 2.0 * np.pi, 9), rng.uniform(0.6, 1.1, 9)
    weight = rng.uniform(0.5, 1.0, 9)

    def distance(s: FloatArray, t: FloatArray, size: float) -> FloatArray:
        reach = [
            w * size - np.hypot(s - r * np.cos(a), t - r * np.sin(a))
            for a, r, w in zip(angle, out, weight)
        ]
        return np.asarray(np.max(reach, axis=0))

    return distance


# --- What they do to the grey values -----------------------------------------------------------

Paint = Callable[[Surroundings, FloatArray, np.random.Generator], FloatArray]


def _cover(grey: Callable[[Surroundings, np.random.Generator], float]) -> Paint:
    def paint(about: Surroundings, share: FloatArray, rng: np.random.Generator) -> FloatArray:
        return np.asarray(about.grey * (1.0 - share) + share * grey(about, rng))

    return paint


def _light(least: float, most: float) -> Paint:
    def paint(about: Surroundings, share: FloatArray, rng: np.random.Generator) -> FloatArray:
        return np.asarray(about.grey * (1.0 + share * (rng.uniform(least, most) - 1.0)))

    return paint


def _glare(about: Surroundings, share: FloatArray, rng: np.random.Generator) -> FloatArray:
    veil = rng.uniform(0.0, 0.5) * share
    return np.asarray((about.grey + share * rng.uniform(30.0, 150.0)) * (1.0 - veil) + 255.0 * veil)


@dataclass(frozen=True)
class Disturbance:
    """A shape, what it does, and how wide its edge is, radii (least and most)."""

    shape: Callable[[np.random.Generator], Distance]
    paint: Paint
    width: tuple[float, float] = (0.02, 0.04)
    upright: bool = False

    def __call__(self, about: Surroundings, hidden: float, rng: np.random.Generator) -> FloatArray:
        """Grey values with a share of the rim disturbed."""
        distance = self.shape(rng)
        size = _size_for(distance, hidden)
        turn = about.away if self.upright else rng.uniform(0.0, 2.0 * np.pi)
        share = about.share(distance(*about.turned(turn), size), rng.uniform(*self.width))
        return self.paint(about, share, rng)


def _size_for(distance: Distance, hidden: float) -> float:
    """The size at which a share of the rim lies under a shape, by bisection."""
    low, high = 0.0, 3.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        if np.mean(distance(np.cos(_RIM), np.sin(_RIM), middle) > 0.0) < hidden:
            low = middle
        else:
            high = middle
    if high == 3.0:
        raise ValueError(f"a share of {hidden} of the rim is more than this shape can cover")
    return high


DISTURBANCES: dict[str, Disturbance] = {
    "cable": Disturbance(_cables, _cover(lambda p, rng: rng.uniform(0.0, 60.0))),
    "tape": Disturbance(_band, _cover(lambda p, rng: float(rng.choice([30.0, 120.0, 220.0])))),
    "leg": Disturbance(
        _upright_band, _cover(lambda p, rng: float(rng.choice([30.0, 200.0]))), upright=True
    ),
    "table edge": Disturbance(_half_plane, _cover(lambda p, rng: rng.uniform(0.0, 255.0))),
    "paper": Disturbance(
        _sheet, _cover(lambda p, rng: p.disc + rng.uniform(-0.3, 0.6) * (p.disc - p.floor))
    ),
    "stain": Disturbance(_blot, _cover(lambda p, rng: rng.uniform(0.2, 0.8) * p.disc), (0.02, 0.2)),
    "worn paint": Disturbance(_blots, _cover(lambda p, rng: p.floor), (0.02, 0.1)),
    "shadow edge": Disturbance(_half_plane, _light(0.3, 0.7), (0.05, 0.4)),
    "sun patch": Disturbance(_sheet, _light(1.5, 3.0), (0.02, 0.1)),
    "glare": Disturbance(_half_plane, _glare, (0.1, 0.8)),
}


LOOK_ALIKES = ("square", "ring", "oval", "saucer", "plate", "light pool", "lid", "tile")


def look_alike(about: Surroundings, kind: str, rng: np.random.Generator) -> FloatArray:
    """Grey values with one of `LOOK_ALIKES` in the disc's place."""
    s, t = about.turned(rng.uniform(0.0, 2.0 * np.pi))
    radius = np.hypot(s, t)
    width, height = rng.uniform(0.75, 1.25, 2)
    soft, grey = 0.05, about.disc
    if kind == "square":
        distance = np.minimum(width - np.abs(s), height - np.abs(t))
    elif kind == "ring":
        distance = np.minimum(1.0 - radius, radius - rng.uniform(0.3, 0.85))
    elif kind == "oval":
        distance = 1.0 - np.hypot(s / (0.7 * width), t / (1.2 * height))
    elif kind == "saucer":
        distance = rng.uniform(0.45, 0.75) - radius
    elif kind == "plate":
        distance = rng.uniform(1.3, 1.6) - radius
    elif kind == "light pool":
        distance, soft = 1.3 - radius, rng.uniform(0.15, 0.3)
    elif kind == "lid":
        distance = rng.uniform(2.0, 3.2) - radius
        grey = about.floor * rng.uniform(0.4, 1.6)
    elif kind == "tile":
        distance = 1.5 - np.maximum(np.abs(s), np.abs(t))
    else:
        raise ValueError(f"{kind}: expected one of {', '.join(LOOK_ALIKES)}")
    bare = np.where(radius < 1.15, about.floor, about.grey)
    share = about.share(distance, soft)
    return np.asarray(bare * (1.0 - share) + share * grey)


# --- Real images -------------------------------------------------------------------------------


def disturbed(
    image: ByteArray, floor_xy: Float32Array, place: FloatArray, radius: float, kind: str,
    rng: np.random.Generator,
) -> ByteArray:  # fmt: skip
    """An image with one light disc disturbed, at a random share of its rim.
    `image` (H, W); `floor_xy` (H, W, 2); `place` (2,).
    """
    window, about = _surroundings(image, floor_xy, place, radius)
    grey = DISTURBANCES[kind](about, rng.uniform(*_SHARES), rng)
    return _with(image, window, about.grey, grey, rng)


def replaced(
    image: ByteArray, floor_xy: Float32Array, place: FloatArray, radius: float, kind: str,
    rng: np.random.Generator,
) -> ByteArray:  # fmt: skip
    """An image with one of `LOOK_ALIKES` instead of a disc; parameters as of `disturbed`."""
    window, about = _surroundings(image, floor_xy, place, radius)
    return _with(image, window, about.grey, look_alike(about, kind, rng), rng)


def with_disc(
    image: ByteArray, floor_xy: Float32Array, place: FloatArray, radius: float,
    rng: np.random.Generator,
) -> ByteArray:  # fmt: skip
    """An image with a light disc on the floor; parameters as of `disturbed`."""
    window, about = _surroundings(image, floor_xy, place, radius)
    light = min(max(about.floor * math.exp(rng.uniform(0.2, 1.4)), about.floor + 15.0), 252.0)
    distance = 1.0 - np.hypot(about.offset[..., 0], about.offset[..., 1])
    share = about.share(distance, about.pixel * rng.uniform(0.3, 0.8))
    # In places the floor's own light and shadow are seen on the disc, too.
    shade = (np.maximum(about.grey, 1.0) / max(about.floor, 1.0)) ** rng.uniform(0.0, 0.7)
    grey = about.grey * (1.0 - share) + share * np.minimum(light * shade, 255.0)
    return _with(image, window, about.grey, grey, rng)


_Window = tuple[slice, slice]


def _surroundings(
    image: ByteArray, floor_xy: Float32Array, place: FloatArray, radius: float
) -> tuple[_Window, Surroundings]:
    offset = (floor_xy - place.astype(np.float32)) / np.float32(radius)
    rows, columns = np.nonzero(np.hypot(offset[..., 0], offset[..., 1]) < REACH)
    window = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    about = Surroundings.of(
        image[window].astype(np.float64),
        offset[window].astype(np.float64),
        float(np.arctan2(place[1], place[0])),
    )
    return window, about


def _with(
    image: ByteArray,
    window: _Window,
    before: FloatArray,
    grey: FloatArray,
    rng: np.random.Generator,
) -> ByteArray:
    """An image with other grey values in a window, and noise where they are others."""
    noisy = grey + (np.abs(grey - before) > 1.0) * rng.normal(0.0, 0.8, grey.shape)
    result = image.copy()
    result[window] = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    return result
