"""Textured rectangles in space, the only thing that scenes with markers are made of.

Frame of a surface, as of a marker: origin at its centre, x right, y up, z out of the printed face
towards a viewer; metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

#: Outward face of each side of a box, as the surface's x and y axes in the box's frame.
_SIDES = {
    "front": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "rear": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "left": ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "right": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "top": ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0)),
}


@dataclass(frozen=True, eq=False)
class Texture:
    """What is printed on a surface.

    Attributes
    ----------
    values : (R, C) float32
        Reflectance of each texel, 0 black to 1 white; NaN is a hole. Row 0 is the upper edge.
    smooth : bool
        Whether it is interpolated between the texels' centres; else every texel is a rectangle of
        one value with sharp edges. A smooth texture has no holes.
    """

    values: NDArray[np.float32]
    smooth: bool = False


def plain(value: float) -> Texture:
    """A texture of one reflectance."""
    return Texture(np.full((1, 1), value, dtype=np.float32))


@dataclass(frozen=True, eq=False)
class Surface:
    """A rectangle with a texture.

    Attributes
    ----------
    pose : (4, 4) float64
        parent_from_surface.
    width_m, height_m : float
        Its extent along x and y.
    texture : Texture
        Of its printed face.
    back : float
        Reflectance of its other face; NaN where that one cannot be seen, as inside a box.
    """

    pose: FloatArray
    width_m: float
    height_m: float
    texture: Texture
    back: float = field(default=np.nan)

    def moved(self, transform: FloatArray) -> Surface:
        """The surface in another frame: `transform` is other_from_parent."""
        return replace(self, pose=transform @ self.pose)

    def corners(self) -> FloatArray:
        """(4, 3) top left, top right, bottom right, bottom left corner in the parent frame."""
        return square_corners(self.width_m, self.height_m) @ self.pose[:3, :3].T + self.pose[:3, 3]


def square_corners(width_m: float, height_m: float | None = None) -> FloatArray:
    """(4, 3) corners in a marker's frame: top left, top right, bottom right, bottom left."""
    x = 0.5 * width_m
    y = x if height_m is None else 0.5 * height_m
    return np.array([[-x, y, 0.0], [x, y, 0.0], [x, -y, 0.0], [-x, -y, 0.0]])


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product of two single vectors, many times as quick as NumPy's."""
    a0, a1, a2 = a.tolist()
    b0, b1, b2 = b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def pose_of(x_axis: ArrayLike, y_axis: ArrayLike, origin: ArrayLike) -> FloatArray:
    """parent_from_surface of a surface whose x and y axes are given as unit vectors."""
    x, y = np.asarray(x_axis, dtype=np.float64), np.asarray(y_axis, dtype=np.float64)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = x, y, cross(x, y)
    pose[:3, 3] = origin
    return pose


def box_sides(
    size_m: ArrayLike, textures: dict[str, Texture], pose: FloatArray | None = None
) -> list[Surface]:
    """The sides of a box that stands on the origin.

    Parameters
    ----------
    size_m : (3,) array
        Its extent along x (front to rear), y (left to right) and z (height).
    textures : dict
        Of the sides ``front`` (+x), ``rear``, ``left`` (+y), ``right``, ``top``; those not named
        are left out.
    pose : (4, 4) array, optional
        parent_from_box.

    Returns
    -------
    list of Surface
    """
    length, width, height = np.asarray(size_m, dtype=np.float64)
    parent = np.eye(4) if pose is None else pose
    centre = np.array([0.0, 0.0, 0.5 * height])
    half = 0.5 * np.array([length, width, height])
    result = []
    for side, texture in textures.items():
        x_axis, y_axis = np.array(_SIDES[side][0]), np.array(_SIDES[side][1])
        outward = cross(x_axis, y_axis)
        local = pose_of(x_axis, y_axis, centre + outward * half)
        across = 2.0 * float(np.abs(x_axis) @ half)
        upward = 2.0 * float(np.abs(y_axis) @ half)
        result.append(Surface(parent @ local, across, upward, texture))
    return result
