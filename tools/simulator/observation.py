"""What is truly in view: discs and vertical edges, and the quality of discs in an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from camera import Camera
from redetect.array_types import BoolArray, ByteArray, FloatArray, IntArray
from redetect.landmarks import CircleLandmark, LineLandmark
from redetect.slam.models import disc_in_robot
from tools.simulator.driving import planar_transform
from tools.simulator.ray_kernels import points_visible
from tools.simulator.renderer import camera_in_world
from tools.simulator.scene import Scene, UprightEdge

INNER_M, OUTER_M = 0.06, 0.14
SAMPLES = 16


def disc_quality(grey: ByteArray, camera: Camera, pixel: ArrayLike) -> float:
    """Otsu quality of a disc whose centre is seen at a pixel. `grey` (H, W); `pixel` (2,)."""
    centre = camera.floor_from_pixel(np.asarray(pixel, dtype=np.float64))
    angle = np.arange(SAMPLES) * (2.0 * np.pi / SAMPLES)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    outlines = centre + np.array([INNER_M, OUTER_M])[:, None, None] * circle
    seen = camera.project_floor(outlines)
    if np.isnan(seen).any():
        return 0.0
    u = np.clip(np.rint(seen[..., 0]).astype(int), 0, grey.shape[1] - 1)
    v = np.clip(np.rint(seen[..., 1]).astype(int), 0, grey.shape[0] - 1)
    values = grey[v, u].astype(np.float64)
    total = values.var()
    if total <= 0.0:
        return 0.0
    difference = values[0].mean() - values[1].mean()
    return float(0.25 * difference * difference / total)


#: The centre of a row lies at least this many pixels inside the image, as in the data set.
BORDER_PX = 12
#: And adjacent pixels there are at most this far apart on the floor (m), as in the data set.
FAR_LIMIT_M = 0.05
#: At least this share of the area of a row's disc is in view.
LEAST_SHARE = 0.8

_DISC_POINTS = 60
_DISC_REACH_M = 8.0
_EDGE_POINTS = 80
_EDGE_REACH_M = 12.0
#: As good as infinitely far.
_FAR_M = 1e6
_SLACK_M = 0.02
_EDGE_CONTRAST_ROWS = 20
_EDGE_CONTRAST_GREY = 12.0
_EDGE_PEAK_PX = 1.0
_PROFILE_PX = np.arange(-6.0, 6.01, 0.5)
_SLOPE = np.array([1.0, 1.0, 0.0, -1.0, -1.0]) / 3.0
_POSITION_SIGMA_M = 0.04


@dataclass(frozen=True)
class SeenDisc:
    """A disc within 8 m that is at least partly in view.

    `robot_xy` is its true place in the level robot frame (m), `pixel` where the true camera sees
    its centre, `share` the part of its area that is in the image and not hidden.
    """

    disc_id: int
    robot_xy: FloatArray
    pixel: FloatArray
    share: float
    occluded: bool
    cut: bool
    listed: bool


@dataclass(frozen=True)
class SeenEdge:
    """A vertical edge, the longest stretch of it that is in view.

    `ends` are pixels of its top and bottom, `normalised` the same undistorted; `bearing_rad` is its
    true bearing from the camera's centre in the level robot frame; `contrast` the median step in
    grey values across it, `rows` the number of image rows that show it, `peak_px` its distance from
    the nearest peak of the image's gradient; `crosses`: it is seen where it crosses the horizon,
    `BORDER_PX` inside the image. A detector of verticals begins there: below the horizon, the foot
    of a shelf may lean like any line on the floor.
    """

    edge_id: int
    ends: FloatArray
    normalised: FloatArray
    bearing_rad: float
    contrast: float
    rows: int
    peak_px: float
    crosses: bool

    @property
    def listed(self) -> bool:
        """Whether it crosses the horizon, long and clear enough for a row of its own."""
        return (
            self.crosses
            and self.rows >= _EDGE_CONTRAST_ROWS
            and abs(self.contrast) >= _EDGE_CONTRAST_GREY
            and self.peak_px <= _EDGE_PEAK_PX
        )


def see_discs(
    scene: Scene,
    nominal: Camera,
    true: Camera,
    pose: FloatArray,
    disc_ids: IntArray,
    disc_xy: FloatArray,
    radius_m: float,
) -> list[SeenDisc]:
    """Which discs are in view from a pose. `pose` (3,); `disc_ids` (M,); `disc_xy` (M, 2)."""
    robot_xy = disc_in_robot(pose, disc_xy)
    pixels = true.project_floor(robot_xy)
    inside = _in_image(true, pixels)
    eye = camera_in_world(true, pose)[:, 3]
    spots = _sunflower(_DISC_POINTS) * radius_m
    seen: list[SeenDisc] = []
    near = np.hypot(robot_xy[:, 0], robot_xy[:, 1]) < _DISC_REACH_M
    for k in np.flatnonzero(inside & near):
        world_xy = disc_xy[k] + spots
        world = np.column_stack([world_xy, np.full(len(spots), 1e-3)])
        free = points_visible(scene, eye, world, _SLACK_M)
        uv = true.project_floor(disc_in_robot(pose, world_xy))
        within = _in_image(true, uv)
        share = float((free & within).mean())
        if share <= 0.0:
            continue
        seen.append(
            SeenDisc(
                disc_id=int(disc_ids[k]), robot_xy=robot_xy[k], pixel=pixels[k], share=share,
                occluded=not bool(free.all()), cut=not bool(within.all()),
                listed=share >= LEAST_SHARE and _within_limits(nominal, pixels[k]),
            )
        )  # fmt: skip
    return sorted(seen, key=lambda d: (round(float(d.pixel[1])), round(float(d.pixel[0]))))


def circle_row(
    disc: SeenDisc, nominal: Camera, grey: ByteArray | None, disc_id: int
) -> CircleLandmark:
    """Row of a disc: its true place, the published covariance, and the image's quality there.
    `grey` (H, W).
    """
    pixel = np.rint(disc.pixel)
    covariance = published_covariance(nominal, pixel)
    quality = 1.0 if grey is None else disc_quality(grey, nominal, pixel)
    return CircleLandmark(
        float(disc.robot_xy[0]), float(disc.robot_xy[1]), quality,
        float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1]), (disc_id,),
    )  # fmt: skip


def published_covariance(camera: Camera, pixel: FloatArray) -> FloatArray:
    """(2, 2) covariance of a disc seen at a pixel: (0.04 m)^2 I + 2 px^2 J J^T."""
    jacobian = camera.floor_jacobian_published(pixel)
    return np.asarray(_POSITION_SIGMA_M**2 * np.eye(2) + 2.0 * jacobian @ jacobian.T)


def see_edges(
    scene: Scene, true: Camera, pose: FloatArray, edges: list[UprightEdge], grey: ByteArray
) -> list[SeenEdge]:
    """Which vertical edges within 12 m are in view from a pose. `grey` (H, W)."""
    eye = camera_in_world(true, pose)[:, 3]
    place = np.array([[e.x, e.y] for e in edges]).reshape(-1, 2)
    heights = np.array([[e.z0, e.z1] for e in edges]).reshape(-1, 2)
    off = place - eye[:2]
    ahead = np.array([np.sin(pose[2]), -np.cos(pose[2])])
    near = np.flatnonzero((np.hypot(off[:, 0], off[:, 1]) < _EDGE_REACH_M) & (off @ ahead > 0.05))
    world = np.empty((len(near), _EDGE_POINTS, 3))
    world[..., :2] = place[near, None]
    share = np.linspace(1.0, 0.0, _EDGE_POINTS)
    world[..., 2] = heights[near, :1] + share * (heights[near, 1:] - heights[near, :1])
    world_to_level = np.linalg.inv(planar_transform(*pose))
    level = world @ world_to_level[:3, :3].T + world_to_level[:3, 3]
    uv = true.project_robot(level)
    visible = (
        (uv[..., 0] >= 3.0) & (uv[..., 0] < true.width - 3.0)
        & (uv[..., 1] >= 0.0) & (uv[..., 1] <= true.height - 1.0)
    )  # fmt: skip
    visible[visible] = points_visible(scene, eye, world[visible], _SLACK_M)
    seen: list[SeenEdge] = []
    for k in np.flatnonzero(visible.sum(axis=1) >= 2):
        first, last = _longest_run(visible[k])
        if last - first < 1:
            continue
        contrast, rows, peak_px = _appearance(grey, uv[k, first : last + 1])
        ends = uv[k, [first, last]]
        top = level[k, first] - true.centre
        far = true.centre + _FAR_M * np.array([top[0], top[1], 0.0]) / np.hypot(top[0], top[1])
        u, v = true.project_robot(far)
        seen.append(
            SeenEdge(
                edge_id=int(near[k]), ends=ends, normalised=true.undistort(ends),
                bearing_rad=float(np.arctan2(top[0], -top[1])), contrast=contrast, rows=rows,
                peak_px=peak_px,
                crosses=bool(
                    ends[0, 1] <= v <= ends[1, 1] and BORDER_PX <= u < true.width - BORDER_PX
                ),
            )
        )  # fmt: skip
    return seen


def line_row(edge: SeenEdge, nominal: Camera) -> LineLandmark:
    """Row of an edge: its true bearing, with one pixel as standard deviation.

    The inclination beta is what the nominal (level) camera measures, as in the data set's rows:
    asin(n_z), n the unit normal of the plane through the camera's centre and the edge.
    """
    rays = np.column_stack([edge.normalised, np.ones(2)])
    normal = nominal.rotation @ np.cross(rays[0], rays[1])
    normal /= np.linalg.norm(normal)
    # The sign is the one that makes the plane's bearing point forward.
    if np.cross(normal, [0.0, 0.0, 1.0]) @ [0.0, -1.0, 0.0] < 0.0:
        normal = -normal
    middle = edge.ends.mean(axis=0)
    aside = nominal.directions_robot(middle + np.array([[-0.5, 0.0], [0.5, 0.0]]))
    bearing = np.arctan2(aside[:, 0], -aside[:, 1])
    beta = float(np.arcsin(np.clip(normal[2], -1.0, 1.0)))
    (x0, y0), (x1, y1) = edge.normalised.tolist()
    return LineLandmark(
        x0, y0, x1, y1, alpha=edge.bearing_rad, beta=beta,
        quality=0.0, sigma=float(abs(bearing[0] - bearing[1])), ids=(edge.edge_id,),
    )  # fmt: skip


def _in_image(camera: Camera, pixels: FloatArray) -> BoolArray:
    size = np.array([camera.width, camera.height])
    return np.asarray(np.all((pixels >= -0.5) & (pixels < size - 0.5), axis=-1))


def _within_limits(nominal: Camera, pixel: FloatArray) -> bool:
    u, v = np.rint(pixel)
    if not (
        BORDER_PX <= u <= nominal.width - 1 - BORDER_PX
        and BORDER_PX <= v <= nominal.height - 1 - BORDER_PX
    ):
        return False
    jacobian = nominal.floor_jacobian_published(np.array([u, v]))
    if np.isnan(jacobian).any():
        return False
    return bool(np.linalg.norm(jacobian, 2) <= FAR_LIMIT_M)


def _sunflower(count: int) -> FloatArray:
    """(count, 2) points spread evenly over the unit disc."""
    k = np.arange(count)
    radius = np.sqrt((k + 0.5) / count)
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def _longest_run(flags: BoolArray) -> tuple[int, int]:
    """First and last index of the longest run of true values; there is at least one."""
    steps = np.diff(flags.astype(np.int8), prepend=0, append=0)
    begin, end = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1) - 1
    best = int(np.argmax(end - begin))
    return int(begin[best]), int(end[best])


def _appearance(grey: ByteArray, uv: FloatArray) -> tuple[float, int, float]:
    """How an edge shows in the image along its points (u, v).

    Returns the median step in grey values across it (right minus left), how many rows show it, and
    the distance (px) to the nearest peak of the gradient (infinite if there is none near).
    """
    top, bottom = int(np.ceil(uv[:, 1].min())), int(np.floor(uv[:, 1].max()))
    if bottom < top:
        return 0.0, 0, float("inf")
    rows = np.arange(top, bottom + 1)
    order = np.argsort(uv[:, 1])
    u = np.interp(rows, uv[order, 1], uv[order, 0])
    # Grey values at equal distances from the edge, row by row.
    at = np.clip(u[:, None] + _PROFILE_PX, 0.0, grey.shape[1] - 1.001)
    left = at.astype(int)
    share = at - left
    values = grey[rows[:, None], left] * (1.0 - share) + grey[rows[:, None], left + 1] * share
    beside = (np.abs(_PROFILE_PX) >= 2.0) & (np.abs(_PROFILE_PX) <= 3.0)
    step = values[:, beside & (_PROFILE_PX > 0.0)].mean(axis=1)
    step -= values[:, beside & (_PROFILE_PX < 0.0)].mean(axis=1)
    typical = float(np.median(step))
    shown = int(np.sum(step * np.sign(typical) >= 0.5 * _EDGE_CONTRAST_GREY))
    slope = np.abs(np.convolve(values.mean(axis=0), _SLOPE, mode="valid"))
    middle = slope[1:-1]
    peaks = (middle >= slope[:-2]) & (middle >= slope[2:]) & (middle >= 0.25 * slope.max())
    offsets = _PROFILE_PX[len(_SLOPE) // 2 + 1 : -(len(_SLOPE) // 2) - 1][peaks]
    return typical, shown, float(np.min(np.abs(offsets), initial=np.inf))
