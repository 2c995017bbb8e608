"""Scenes for the ray caster, and their construction from walls, boxes and marks.

World frame: the building's floor plan in x and y, z up, the floor at z = 0; metres. The robot frame
turns into it by a rotation about z and a shift: a robot at heading 0 looks along -y.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from redetect.array_types import ByteArray, Float32Array, FloatArray, IntArray


class Texture(IntEnum):
    """How the albedo of a surface varies over it."""

    PLAIN = 0
    WALL = 1
    WOOD = 2
    PHOTOGRAPH = 3
    PAPER = 4
    WINDOW = 5
    FACADE = 6
    FOLIAGE = 7
    METAL = 8


class Flooring(IntEnum):
    """How the albedo of the floor varies over it."""

    LINOLEUM = 0
    CARPET = 1
    TILES = 2
    PARQUET = 3
    PAVING = 4
    GRASS = 5


class Mark(IntEnum):
    """Shapes lying flat on the floor."""

    DISC = 0
    RING = 1
    ELLIPSE = 2
    PLATE = 3
    RECTANGLE = 4
    LIGHT_SPOT = 5
    PRINTED = 6


def _record(fields: str) -> np.dtype[np.void]:
    return np.dtype([(name, np.float64) for name in fields.split()])


#: What is known of a parallelogram's surface, a mark on the floor, and a floor covering.
SURFACE = _record("texture albedo parameter emission width height seed")
MARK = _record("shape x y radius second angle albedo gloss reach")
FLOORING = _record("kind albedo contrast gloss pitch")


class Scene(NamedTuple):
    """A world prepared for ray casting."""

    quads: FloatArray
    """(Q, 12) parallelograms: normal, offset; dual vector and offset of the first edge; the same of
    the second. A point p of the plane has the coordinates ``s = dual . p - offset`` in [0, 1]."""
    surfaces: Any  # (Q,) `SURFACE`: what the parallelograms look like.
    quad_start: IntArray
    """(cells + 1,) where each grid cell's parallelograms begin in `quad_items`."""
    quad_items: IntArray
    marks: Any  # (M,) `MARK`: shapes on the floor, later ones on top of earlier ones.
    mark_start: IntArray
    mark_items: IntArray
    grid: FloatArray  # x and y of the grid's corner, side of a cell, cells along x, cells along y.
    floor_kind: NDArray[np.int8]
    """(Ny, Nx) row of `floorings` on a finer raster of the same extent."""
    floorings: Any  # (F,) `FLOORING`
    indoors: ByteArray  # (Ny, Nx) 1 below a ceiling.
    sun_reach: ByteArray  # (Ny, Nx) 1 where the sun may reach the floor through a window.
    floor_light: FloatArray  # (Ny, Nx) light on the floor; 1 makes a white surface white.
    side_light: FloatArray
    """(Ny, Nx, 3) light on upright surfaces: mean, and its change with the normal's x and y."""
    raster_m: float  # Side of a raster element.
    ceiling_m: float  # Height of the ceiling.
    sun: FloatArray  # (4,) direction to the sun (unit vector) and its light on a surface facing it.
    sky: float  # Radiance of the sky.
    photographs: Float32Array  # (P, L, S, S) photographs and their halved versions, 0..1.


CEILING_M = 2.75

_CELL_M = 0.5
_RASTER_M = 0.125
_FLOOR_RAYS = 48
_AZIMUTHS = 16
_PHOTOGRAPH_SIDE = 256
_PHOTOGRAPH_LEVELS = 6


@dataclass(frozen=True)
class Look:
    """What a surface looks like.
    `parameter` is the skirting's albedo of walls and the border (m) of photographs.
    """

    texture: Texture = Texture.PLAIN
    albedo: float = 0.5
    parameter: float = 0.0
    emission: float = 0.0


class Face(NamedTuple):
    """A place on an upright face, metres: things are placed against it."""

    at: FloatArray  # (2,)
    along: FloatArray  # (2,) unit vector along the face.
    out: FloatArray  # (2,) unit vector out of it, into the room.

    def point(self, along: float, out: float = 0.0) -> FloatArray:
        """(2,) the place at these distances along the face and out of it."""
        return np.asarray(self.at + along * self.along + out * self.out)

    def moved(self, along: float, out: float = 0.0) -> Face:
        """The same face at another place."""
        return self._replace(at=self.point(along, out))


@dataclass(frozen=True)
class UprightEdge:
    """A vertical edge of the building or of something in it; metres, world frame."""

    x: float
    y: float
    z0: float
    z1: float
    label: str


@dataclass(frozen=True)
class FloorMark:
    """Something flat on the floor; metres, world frame.
    `disc_id` is the number of a real landmark, -1 for things that only look like one.
    """

    shape: Mark
    x: float
    y: float
    radius: float
    albedo: float
    second: float = 0.0
    angle: float = 0.0
    gloss: float = 0.15
    label: str = "disc"
    disc_id: int = -1

    @property
    def reach(self) -> float:
        """Radius of a circle that holds the mark, metres."""
        if self.shape in (Mark.RECTANGLE, Mark.PRINTED):
            return float(np.hypot(self.radius, self.second))
        if self.shape == Mark.LIGHT_SPOT:
            return 3.0 * self.radius
        return max(self.radius, self.second)


@dataclass
class Construction:
    """A world while it is being built."""

    quads: list[tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)
    edges: list[UprightEdge] = field(default_factory=list)
    marks: list[FloorMark] = field(default_factory=list)
    lamps: list[list[float]] = field(default_factory=list)
    footprints: list[FloatArray] = field(default_factory=list)
    pictures: list[tuple[float, float, float, float, float, float]] = field(default_factory=list)
    faces: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)

    def quad(self, origin: FloatArray, a: FloatArray, b: FloatArray, look: Look) -> None:
        """Add the rectangle with a corner `origin` and the edges `a` and `b` (m)."""
        self.quads.append((origin, a, b))
        self.looks.append(look)

    def upright(
        self, start: FloatArray, end: FloatArray, z0: float, z1: float, look: Look, label: str = ""
    ) -> None:
        """Add an upright rectangle above the segment start-end; its sides are edges if labelled."""
        if z1 - z0 <= 1e-9 or math.dist(start, end) <= 1e-9:
            return
        self.quad(
            np.array([*start, z0]),
            np.array([*(end - start), 0.0]),
            np.array([0.0, 0.0, z1 - z0]),
            look,
        )
        if label:
            for x, y in (start, end):
                self.edges.append(UprightEdge(float(x), float(y), z0, z1, label))

    def level(self, corner: FloatArray, a: FloatArray, b: FloatArray, z: float, look: Look) -> None:
        """Add a level rectangle at height z."""
        self.quad(np.array([*corner, z]), np.array([*a, 0.0]), np.array([*b, 0.0]), look)

    def panel(
        self, face: Face, along: tuple[float, float], z: tuple[float, float], look: Look,
        label: str = "",
    ) -> None:  # fmt: skip
        """Add an upright rectangle on a face: its ends along the face, and heights."""
        self.upright(face.point(along[0]), face.point(along[1]), *z, look, label)

    def block(
        self, face: Face, size: tuple[float, float], z: tuple[float, float], look: Look,
        label: str = "",
    ) -> None:  # fmt: skip
        """Add a box whose middle is a place by a face; `size` is along the face and out of it."""
        self.box(face.at, *size, *z, look, label, face.along)

    def box(
        self, centre: FloatArray, width: float, depth: float, z0: float, z1: float, look: Look,
        label: str = "", along: FloatArray | None = None,
    ) -> None:  # fmt: skip
        """Add a box; `along` is the unit vector of its width, x by default."""
        e = np.array([1.0, 0.0]) if along is None else along
        n = np.array([-e[1], e[0]])
        a, b = 0.5 * width * e, 0.5 * depth * n
        ring = [centre - a - b, centre + a - b, centre + a + b, centre - a + b]
        for k in range(4):
            self.upright(ring[k], ring[(k + 1) % 4], z0, z1, look)
            x, y = float(ring[k][0]), float(ring[k][1])
            self.edges.append(UprightEdge(x, y, z0, z1, label or "other"))
        if z1 < CEILING_M:
            self.level(ring[0], width * e, depth * n, z1, look)
        if z0 > 0.0:
            self.level(ring[0], width * e, depth * n, z0, look)
        if z0 < 0.3:
            self.footprints.append(np.array(ring))

    def lamp(self, x: float, y: float, width: float, depth: float, radiance: float) -> None:
        """Add a lamp at the ceiling."""
        z = CEILING_M - 0.02
        corner = np.array([x - 0.5 * width, y - 0.5 * depth])
        self.level(
            corner, np.array([width, 0.0]), np.array([0.0, depth]), z, Look(emission=radiance)
        )
        self.lamps.append([x, y, z, width, depth, radiance])

    def add_crossing_edges(self) -> None:
        """Add the edges where faces of walls that were built apart meet."""
        for k, (a0, a1) in enumerate(self.faces):
            along_a = a1 - a0
            for b0, b1 in self.faces[k + 1 :]:
                along_b = b1 - b0
                across = along_a[0] * along_b[1] - along_a[1] * along_b[0]
                if abs(across) < 1e-6:
                    continue
                off = b0 - a0
                s = (off[0] * along_b[1] - off[1] * along_b[0]) / across
                t = (off[0] * along_a[1] - off[1] * along_a[0]) / across
                if -1e-6 <= s <= 1.0 + 1e-6 and -1e-6 <= t <= 1.0 + 1e-6:
                    x, y = a0 + s * along_a
                    self.edges.append(UprightEdge(float(x), float(y), 0.0, CEILING_M, "corner"))

    def sides(self) -> FloatArray:
        """(3, Q, 3) a corner of each rectangle and both edges from there."""
        return np.moveaxis(np.array(self.quads).reshape(-1, 3, 3), 1, 0)

    def corners(self) -> FloatArray:
        """(Q, 4, 3) corners of all rectangles."""
        origin, a, b = self.sides()
        return np.stack([origin, origin + a, origin + b, origin + a + b], axis=1)

    def distinct_edges(self) -> list[UprightEdge]:
        """All edges, those at one place (1 mm) with touching heights joined."""
        piles: dict[tuple[int, int], list[UprightEdge]] = {}
        for edge in self.edges:
            piles.setdefault((round(edge.x * 1000), round(edge.y * 1000)), []).append(edge)
        distinct: list[UprightEdge] = []
        for pile in piles.values():
            joined: list[UprightEdge] = []
            for edge in sorted(pile, key=lambda e: (e.z0, -e.z1)):
                last = joined[-1] if joined else None
                if last is not None and edge.z0 <= last.z1 + 1e-3:
                    joined[-1] = UprightEdge(
                        last.x, last.y, last.z0, max(last.z1, edge.z1), last.label
                    )
                else:
                    joined.append(edge)
            distinct += joined
        return distinct


def make_scene(
    building: Construction,
    extent: tuple[float, float, float, float],
    floor_kind: NDArray[np.int8],
    floorings: FloatArray,
    indoors: ByteArray,
    sun: tuple[float, float, float, float] = (0.0, 0.0, -1.0, 0.0),
    sky: float = 3.0,
    *,
    lit: bool = True,
) -> Scene:
    """Prepare a world for ray casting: sort it into a grid and bake its light.

    `extent` (x0, y0, x1, y1); `floor_kind` (Ny, Nx); `floorings` (F, 5); `indoors` (Ny, Nx); `sun`
    (x, y, z, light).
    """
    from tools.simulator.ray_kernels import bake_light

    x0, y0, x1, y1 = extent
    columns, rows = int(np.ceil((x1 - x0) / _CELL_M)), int(np.ceil((y1 - y0) / _CELL_M))
    grid = np.array([x0, y0, _CELL_M, columns, rows])
    quads, surfaces = _rectangles(building)
    corners = building.corners()[:, :, :2]
    quad_boxes = np.hstack([corners.min(axis=1), corners.max(axis=1)])
    marks = np.array(
        [
            [m.shape, m.x, m.y, m.radius, m.second, m.angle, m.albedo, m.gloss, m.reach]
            for m in building.marks
        ]
    ).reshape(-1, 9)
    mark_boxes = marks[:, [1, 2, 1, 2]] + marks[:, 8:9] * np.array([-1.0, -1.0, 1.0, 1.0])
    quad_start, quad_items = _sorted_into_cells(quad_boxes, grid)
    mark_start, mark_items = _sorted_into_cells(mark_boxes, grid)
    scene = Scene(
        quads=quads,
        surfaces=surfaces,
        quad_start=quad_start,
        quad_items=quad_items,
        marks=_records(marks, MARK),
        mark_start=mark_start,
        mark_items=mark_items,
        grid=grid,
        floor_kind=floor_kind,
        floorings=_records(floorings, FLOORING),
        indoors=indoors,
        sun_reach=np.zeros(floor_kind.shape, dtype=np.uint8),
        floor_light=np.zeros(floor_kind.shape),
        side_light=np.zeros((*floor_kind.shape, 3)),
        raster_m=_RASTER_M,
        ceiling_m=CEILING_M,
        sun=np.array([*(np.array(sun[:3]) / np.linalg.norm(sun[:3])), sun[3]]),
        sky=sky,
        photographs=_photographs(),
    )
    if not lit:
        return scene
    lamps = np.array(building.lamps, dtype=np.float64).reshape(-1, 6)
    bake_light(scene, lamps, _cosine_directions(_FLOOR_RAYS), _AZIMUTHS)
    return scene._replace(
        floor_light=gaussian_filter(scene.floor_light, 0.8),
        side_light=np.stack(
            [gaussian_filter(scene.side_light[:, :, k], 1.0) for k in range(3)], axis=-1
        ),
    )


def _rectangles(building: Construction) -> tuple[FloatArray, Any]:
    """`quads` and `surfaces` of a `Scene`."""
    origin, a, b = building.sides()
    across = np.cross(a, b)
    axes = [
        across / np.linalg.norm(across, axis=1, keepdims=True),
        *(side / np.sum(side**2, axis=1, keepdims=True) for side in (a, b)),
    ]
    quads = [np.column_stack([axis, np.sum(axis * origin, axis=1)]) for axis in axes]
    looks = np.array([(k.texture, k.albedo, k.parameter, k.emission) for k in building.looks])
    lengths = [np.linalg.norm(side, axis=1) for side in (a, b)]
    seeds = np.arange(1, len(looks) + 1) * 7919 % 1000003
    surfaces = np.column_stack([looks.reshape(-1, 4), *lengths, seeds])
    return np.hstack(quads), _records(surfaces, SURFACE)


def raster_shape(extent: tuple[float, float, float, float]) -> tuple[int, int]:
    """Rows and columns of the raster that covers an extent (x0, y0, x1, y1) in metres."""
    x0, y0, x1, y1 = extent
    per_cell = round(_CELL_M / _RASTER_M)
    return (
        int(np.ceil((y1 - y0) / _CELL_M)) * per_cell,
        int(np.ceil((x1 - x0) / _CELL_M)) * per_cell,
    )


def raster_slice(
    extent: tuple[float, float, float, float], x0: float, y0: float, x1: float, y1: float
) -> tuple[slice, slice]:
    """Raster elements of a rectangle of the world (m)."""

    def index(value: float, origin: float) -> int:
        return max(round((value - origin) / _RASTER_M), 0)

    return (
        slice(index(y0, extent[1]), index(y1, extent[1])),
        slice(index(x0, extent[0]), index(x1, extent[0])),
    )


def _records(rows: Any, kind: np.dtype[np.void]) -> Any:
    columns = len(kind.names or ())
    return np.array(rows, dtype=np.float64).reshape(-1, columns).view(kind).reshape(-1)


def _sorted_into_cells(boxes: FloatArray, grid: FloatArray) -> tuple[IntArray, IntArray]:
    """Which boxes (x0, y0, x1, y1) touch each cell, as starts and items."""
    x0, y0, side = grid[:3]
    columns, rows = int(grid[3]), int(grid[4])
    cells: list[list[int]] = [[] for _ in range(columns * rows)]
    for k, (bx0, by0, bx1, by1) in enumerate(boxes):
        # A box that lies on the border of two cells belongs to both.
        j0, j1 = int((bx0 - x0 - 1e-6) // side), int((bx1 - x0 + 1e-6) // side)
        i0, i1 = int((by0 - y0 - 1e-6) // side), int((by1 - y0 + 1e-6) // side)
        for i in range(max(i0, 0), min(i1, rows - 1) + 1):
            for j in range(max(j0, 0), min(j1, columns - 1) + 1):
                cells[i * columns + j].append(k)
    start = np.concatenate([[0], np.cumsum([len(c) for c in cells])]).astype(np.int64)
    items = np.array([k for c in cells for k in c], dtype=np.int64)
    return start, items


def _cosine_directions(count: int) -> FloatArray:
    """(count, 3) directions of the upper half space, dense where the cosine is large."""
    k = np.arange(count)
    height = np.sqrt(1.0 - (k + 0.5) / count)
    azimuth = k * np.pi * (3.0 - np.sqrt(5.0))
    level = np.sqrt(1.0 - height**2)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=-1)


@lru_cache(maxsize=1)
def _photographs() -> Float32Array:
    """Photographs that come with scikit-image, each with its halved versions."""
    from skimage import data

    # Only those in the package itself: nothing is fetched.
    images = [data.camera(), data.astronaut(), data.coffee(), data.chelsea(), data.coins(),
              data.text(), data.page(), data.clock(), data.moon(), data.brick(), data.grass(),
              data.hubble_deep_field()]  # fmt: skip
    side = _PHOTOGRAPH_SIDE
    pyramid = np.zeros((len(images), _PHOTOGRAPH_LEVELS, side, side), dtype=np.float32)
    for layer, image in enumerate(images):
        grey = image.astype(np.float32) / 255.0
        if grey.ndim == 3:
            grey = grey[..., :3] @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
        for level in range(_PHOTOGRAPH_LEVELS):
            small = side >> level
            pyramid[layer, level, :small, :small] = cv2.resize(
                grey, (small, small), interpolation=cv2.INTER_AREA
            )
    return pyramid
