"""What lies behind the surfaces: smooth noise, simple shapes, or photographs."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.simulator.markers.clutter import Grey, blotches

_PHOTOGRAPHS = (".jpg", ".jpeg", ".png")
_CACHED_PHOTOGRAPHS = 64


def shapes_background(rng: np.random.Generator, width: int, height: int) -> Grey:
    """Noise with polygons, discs, bars and a grid or two on it, as a messy room has them.

    Parameters
    ----------
    rng : numpy Generator
        Source of chance.
    width, height : int
        Of the image, pixels.

    Returns
    -------
    (height, width) float32
        Reflectance.
    """
    import cv2

    base = 0.15 + 0.6 * rng.random() + 0.35 * (blotches(rng, (height // 4, width // 4)) - 0.5)
    image = np.clip(255.0 * base, 8, 250).astype(np.uint8)
    image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR))
    for _ in range(int(rng.integers(3, 22))):
        shade = int(rng.integers(5, 250))
        centre = rng.uniform(0.0, 1.0, 2) * (width, height)
        kind = rng.random()
        if kind < 0.45:  # the side of some furniture
            size = rng.uniform(10, 160, 2)
            angle = rng.choice([0.0, rng.uniform(-90, 90)])
            corners = cv2.boxPoints((tuple(centre), tuple(size), float(angle)))
            skewed = corners + rng.normal(0.0, 0.06 * size.mean(), (4, 2))
            _fill(image, np.asarray(skewed, dtype=np.float64), shade)
        elif kind < 0.6:
            axes = int(rng.integers(4, 70)), int(rng.integers(4, 70))
            point = int(centre[0]), int(centre[1])
            cv2.ellipse(
                image, point, axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA
            )
        elif kind < 0.8:  # edges of walls, cables, legs
            end = centre + rng.normal(0.0, 200.0, 2)
            cv2.line(
                image, (int(centre[0]), int(centre[1])), (int(end[0]), int(end[1])), shade,
                int(rng.integers(1, 9)), cv2.LINE_AA,
            )  # fmt: skip
        else:  # a shelf or a keyboard: equal rectangles in rows
            step = rng.uniform(8, 30, 2)
            gap = rng.uniform(0.15, 0.5)
            for i in range(int(rng.integers(2, 6))):
                for j in range(int(rng.integers(2, 8))):
                    corner = centre + step * (j, i)
                    far = corner + (1.0 - gap) * step
                    _fill(
                        image,
                        np.array([corner, [far[0], corner[1]], far, [corner[0], far[1]]]),
                        shade,
                    )
    return image.astype(np.float32) / np.float32(255.0)


def _fill(image: NDArray[np.uint8], corners: NDArray[np.float64], shade: int) -> None:
    import cv2

    points = np.rint(16.0 * corners).astype(np.int32)
    cv2.fillConvexPoly(image, cv2.convexHull(points), shade, cv2.LINE_AA, shift=4)


def photograph_files(folder: Path) -> tuple[Path, ...]:
    """The photographs below a folder, in an order that does not depend on the file system."""
    return tuple(sorted(p for p in folder.rglob("*") if p.suffix.lower() in _PHOTOGRAPHS))


def photograph_background(
    rng: np.random.Generator, width: int, height: int, files: tuple[Path, ...]
) -> Grey:
    """A part of a photograph, enlarged or reduced; parameters as in `shapes_background`."""
    import cv2

    photograph = _photograph(files[rng.integers(len(files))])
    rows, columns = photograph.shape
    scale = rng.uniform(0.4, 1.0) * min(columns / width, rows / height)
    across, down = max(2, int(scale * width)), max(2, int(scale * height))
    left, top = rng.integers(0, columns - across + 1), rng.integers(0, rows - down + 1)
    part = photograph[top : top + down, left : left + across]
    if rng.random() < 0.5:
        part = part[:, ::-1]
    reduced = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(reduced).astype(np.float32) / np.float32(255.0)


@lru_cache(maxsize=_CACHED_PHOTOGRAPHS)
def _photograph(path: Path) -> NDArray[np.uint8]:
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(f"{path}: cannot be read as an image")
    return np.asarray(image, dtype=np.uint8)
