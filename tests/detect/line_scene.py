"""Rendered vertical edges with known bearings, for tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from camera import Camera
from camera.model_checks import checked_pose
from detect.lines import LineDetections

FloatArray = NDArray[np.float64]

_LEVEL = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
_SUBROWS = 4


@dataclass(frozen=True)
class Edge:
    """A vertical step of the grey value at a bearing, brighter on the right by `contrast`."""

    bearing_rad: float
    contrast: float


#: Light and dark ones all over the view.
EDGES = (
    Edge(0.45, 60.0),
    Edge(0.30, -40.0),
    Edge(0.14, 70.0),
    Edge(-0.02, -90.0),
    Edge(-0.21, 50.0),
    Edge(-0.40, -35.0),
)


def pinhole(
    width: int = 200,
    height: int = 120,
    focal_px: float = 220.0,
    *,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
    row_aspect: float = 1.0,
    coef: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0),
) -> Camera:
    """A camera that looks forward, pitched down and rolled clockwise."""
    turned = Rotation.from_euler("xz", [-pitch_deg, roll_deg], degrees=True).as_matrix()
    rotation = _LEVEL @ turned
    return Camera(
        width=width,
        height=height,
        scale_x=focal_px,
        scale_y=focal_px / row_aspect,
        offset_x=0.5 * (width - 1),
        offset_y=0.5 * (height - 1),
        coef=coef,
        robot_from_camera=checked_pose("pose", np.column_stack([rotation, [0.0, 0.0, 1.2]])),
    )


def mirrored(camera: Camera) -> Camera:
    """The camera that sees the mirror image, left and right exchanged."""
    flip = np.diag([-1.0, 1.0, 1.0])
    pose = np.column_stack([flip @ camera.rotation @ flip, flip @ camera.centre])
    return replace(
        camera,
        offset_x=camera.width - 1 - camera.offset_x,
        robot_from_camera=checked_pose("pose", pose),
    )


def tilt_of(found: LineDetections) -> FloatArray:
    """Pitch and roll of the tilt that was found (rad)."""
    assert found.tilt is not None
    return np.array([found.tilt.pitch_rad, found.tilt.roll_rad])


def edge_columns(camera: Camera, bearing_rad: float, rows: FloatArray) -> FloatArray:
    """Columns at which the vertical at a bearing crosses fractional rows, from projected points."""
    elevation = np.radians(np.linspace(-70.0, 70.0, 1401))
    direction = np.stack(
        [
            np.cos(elevation) * math.sin(bearing_rad),
            -np.cos(elevation) * math.cos(bearing_rad),
            np.sin(elevation),
        ],
        axis=-1,
    )
    seen = camera.project_robot(camera.centre + 3.0 * direction)
    order = np.argsort(seen[:, 1])
    order = order[np.isfinite(seen[order, 1])]
    u, v = seen[order].T
    near = (v > -3 * camera.height) & (v < 4 * camera.height)
    return np.asarray(CubicSpline(v[near], u[near])(rows))


def render(
    camera: Camera,
    edges: Sequence[Edge],
    *,
    grey: float = 100.0,
    blur_px: float = 0.6,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
) -> NDArray[np.uint8]:
    """Image of edges from the top to the bottom of the view, `grey` on the left of all of them."""
    rows = (np.arange(camera.height * _SUBROWS) + 0.5) / _SUBROWS - 0.5
    columns = np.arange(camera.width)
    image = np.full((camera.height, camera.width), grey)
    for edge in edges:
        distance = columns - edge_columns(camera, edge.bearing_rad, rows)[:, None]
        share = _blurred_pixel(distance, blur_px)
        image += edge.contrast * share.reshape(camera.height, _SUBROWS, -1).mean(axis=1)
    if rng is not None:
        image = image + rng.normal(0.0, noise, image.shape)
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)


def _blurred_pixel(distance: FloatArray, blur: float) -> FloatArray:
    """Integral over a pixel of a step blurred by a Gaussian."""

    def primitive(z: FloatArray) -> FloatArray:
        return np.asarray(z * ndtr(z) + np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi))

    share = np.where(distance > 0.0, 1.0, 0.0)
    near = np.abs(distance) < 0.5 + 9.0 * blur  # farther off it is 0 or 1 to the last digits
    upper, lower = (distance[near] + 0.5) / blur, (distance[near] - 0.5) / blur
    share[near] = blur * (primitive(upper) - primitive(lower))
    return share
