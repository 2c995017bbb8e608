"""Where the discs lie, and the things that look like discs."""

from __future__ import annotations

import numpy as np

from tools.simulator.construction import Construction, FloorMark
from tools.simulator.scene import FloatArray, Mark

DISC_RADIUS_M = 0.10

_ALONG_SIDE_M = (0.15, 2.2)
_APART_M = 0.34
_FROM_FURNITURE_M = 0.17
_LOOKALIKES = ("ring", "ellipse", "large disc", "dark disc", "plate", "paper", "sheet",
               "light spot", "small disc", "square", "cable")  # fmt: skip


def lay_discs(
    building: Construction,
    path: FloatArray,
    count: int,
    lookalikes: int,
    rng: np.random.Generator,
    within: tuple[float, float, float, float],
) -> None:
    """Lay discs and lookalikes on the floor on both sides of a path.

    Parameters
    ----------
    building : Construction
        The world; what is laid is added to its marks.
    path : (N, 3) array
        Poses of the robot (m, rad).
    count, lookalikes : int
        How many discs and other things to lay. Discs are numbered from 1 in the order in which the
        path comes by.
    rng : numpy Generator
        Draws the places.
    within : (x0, y0, x1, y1)
        The world's borders (m).

    Raises
    ------
    ValueError
        If there is no room for so many.
    """
    total = count + lookalikes
    boxes = _boxes(building)
    walls = _low_segments(building)
    chosen: list[tuple[float, float, float]] = []
    tries = 0
    while len(chosen) < total:
        tries += 1
        if tries > 200 * total:
            raise ValueError(f"only {len(chosen)} of {total} marks fit on the floor by the path")
        at = rng.uniform(0.0, len(path) - 1.0)
        pose = path[int(at)]
        aside = rng.uniform(*_ALONG_SIDE_M) * rng.choice([-1.0, 1.0])
        ahead = rng.uniform(-0.3, 1.8)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        x = pose[0] + c * aside + s * ahead
        y = pose[1] + s * aside - c * ahead
        if not (within[0] + 1 < x < within[2] - 1 and within[1] + 1 < y < within[3] - 1):
            continue
        place = np.array([x, y])
        if any(np.hypot(x - a, y - b) < _APART_M for a, b, _ in chosen):
            continue
        if _crowded(place, pose[:2], boxes, walls):
            continue
        chosen.append((x, y, float(at)))
    order = rng.permutation(total)
    discs = sorted((chosen[k] for k in order[:count]), key=lambda c: c[2])
    for number, (x, y, _) in enumerate(discs, start=1):
        building.marks.append(
            FloorMark(
                Mark.DISC, x, y, DISC_RADIUS_M, float(rng.uniform(0.78, 0.92)), disc_id=number
            )
        )
    for k, index in enumerate(order[count:]):
        x, y, _ = chosen[index]
        building.marks.append(_lookalike(_LOOKALIKES[k % len(_LOOKALIKES)], x, y, rng))


def _lookalike(label: str, x: float, y: float, rng: np.random.Generator) -> FloorMark:
    angle = float(rng.uniform(0.0, np.pi))
    shapes = {
        "ring": (Mark.RING, 0.10, 0.055, 0.85),
        "ellipse": (Mark.ELLIPSE, 0.16, 0.06, 0.8),
        "large disc": (Mark.DISC, 0.16, 0.0, 0.8),
        "dark disc": (Mark.DISC, 0.10, 0.0, 0.05),
        "plate": (Mark.PLATE, 0.125, 0.085, 0.8),
        "paper": (Mark.RECTANGLE, 0.149, 0.105, 0.85),
        "sheet": (Mark.PRINTED, 0.149, 0.105, 0.85),
        "light spot": (Mark.LIGHT_SPOT, 0.11, 0.0, 1.2),
        "small disc": (Mark.DISC, 0.055, 0.0, 0.8),
        "square": (Mark.RECTANGLE, 0.09, 0.09, 0.8),
        "cable": (Mark.RECTANGLE, 0.6, 0.012, 0.05),
    }
    shape, radius, second, albedo = shapes[label]
    return FloorMark(shape, x, y, radius, albedo, second, angle, label=label)


def _boxes(building: Construction) -> list[tuple[FloatArray, FloatArray]]:
    return [(ring.min(axis=0), ring.max(axis=0)) for ring in building.footprints]


def _low_segments(building: Construction) -> FloatArray:
    """(K, 4) ground plan of everything upright that reaches the floor."""
    low = [c for c in building.corners if c[:, 2].min() < 0.02 and np.ptp(c[:, 2]) > 0.02]
    return np.array([[*c[0, :2], *c[1, :2]] for c in low]).reshape(-1, 4)


def _crowded(
    place: FloatArray,
    seen_from: FloatArray,
    boxes: list[tuple[FloatArray, FloatArray]],
    walls: FloatArray,
) -> bool:
    """Whether something stands on, next to or between the place and the path."""
    for low, high in boxes:
        if np.all(place > low - _FROM_FURNITURE_M) and np.all(place < high + _FROM_FURNITURE_M):
            return True
    a, b = walls[:, :2], walls[:, 2:]
    along = b - a
    squared = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip(((place - a) * along).sum(axis=1) / squared, 0.0, 1.0)
    if np.hypot(*(place - a - share[:, None] * along).T).min() < _FROM_FURNITURE_M:
        return True
    way = place - seen_from
    cross = way[0] * along[:, 1] - way[1] * along[:, 0]
    safe = np.where(np.abs(cross) < 1e-12, np.inf, cross)
    off = a - seen_from
    s = (off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0]) / safe
    t = (off[:, 0] * way[1] - off[:, 1] * way[0]) / safe
    return bool(np.any((s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)))
