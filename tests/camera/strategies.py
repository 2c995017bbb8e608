"""Random valid cameras for property tests."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from camera import Camera, CameraError
from camera.distortion import Coef, Lens, fold_radius, inverse_table
from camera.model import Pose
from camera.model_checks import border_pixels

#: No camera of these tests looks farther to the side than this (80 deg off the axis).
WIDEST = math.tan(math.radians(80.0))


def largest_distorted_radius(coef: Coef) -> float:
    """Largest distorted radius at which a ray is seen."""
    return float(inverse_table(Lens(coef))[0][-1])


def coefficients() -> st.SearchStrategy[Coef]:
    """Distortions, from none through barrel to pincushion, folding far out or not at all.

    None that grows into a pole of f: next to one nothing can be computed, nor is there such a lens.
    """
    small = st.floats(-0.4, 0.4)
    return st.tuples(
        small, small, st.floats(-0.2, 1.5), st.floats(-0.2, 1.5), st.floats(-0.5, 0.5)
    ).filter(_has_no_pole)


def _has_no_pole(coef: Coef) -> bool:
    end = min(fold_radius(Lens(coef)), 25.0)
    denominator = np.polyval([*coef[:1:-1], 1.0], np.linspace(0.0, end, 150))
    return bool(np.all(denominator > 0.05))


@st.composite
def poses(draw: st.DrawFn, *, down_deg: tuple[float, float] = (-180.0, 180.0)) -> Pose:
    """Transforms camera -> robot of cameras above the floor.

    `down_deg` is how far the optical axis points below the horizon. Numbers have the few digits of
    a file, so rotations are rotations only to 1e-5.
    """
    heading, down, roll = draw(
        st.tuples(st.floats(-180.0, 180.0), st.floats(*down_deg), st.floats(-180.0, 180.0))
    )
    # Robot axes: forward is -Y, left is X, up is Z.
    level = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
    turn = Rotation.from_euler("ZX", [heading, down], degrees=True).as_matrix()
    rotation = turn @ level @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    centre = draw(st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.3, 3.0)))
    rows = np.round(np.column_stack([rotation, centre]), 6)
    return tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in rows)


@st.composite
def cameras(
    draw: st.DrawFn,
    *,
    largest_side: int = 2000,
    down_deg: tuple[float, float] = (-180.0, 180.0),
) -> Camera:
    """Valid cameras of any size, focal length, principal point, distortion and pose.

    Every other one has tangential terms, and every other one a polynomial, where its image is not
    too near to the fold for them.
    """
    width = draw(st.integers(8, largest_side))
    height = draw(st.integers(8, largest_side))
    offset_x = width * draw(st.floats(0.2, 0.8))
    offset_y = height * draw(st.floats(0.2, 0.8))
    aspect = draw(st.sampled_from([0.5, 1.0, 1.01]))
    coef = draw(coefficients())
    farthest_px = math.hypot(
        max(offset_x, width - offset_x), max(offset_y, height - offset_y) / aspect
    )
    # The image's corner uses up this part of what the distortion lets the camera see.
    used = draw(st.floats(0.05, 0.95))
    scale_x = farthest_px / (used * min(largest_distorted_radius(coef), WIDEST))
    camera = Camera(
        width=width,
        height=height,
        scale_x=scale_x,
        scale_y=aspect * scale_x,
        offset_x=offset_x,
        offset_y=offset_y,
        coef=coef,
        robot_from_camera=draw(poses(down_deg=down_deg)),
    )
    if draw(st.booleans()):
        tangential = draw(st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)))
        camera = _where_it_stays_whole(camera, tangential=tangential)
    if draw(st.booleans()):
        # Of an image that reaches to 80 degrees only a small share would still be one-to-one.
        reach = min(farthest_px / scale_x, 3.0)
        k1, k2, k3 = draw(st.tuples(*[st.floats(-0.1, 0.2)] * 3))
        polynomial = (k1 / reach**2, k2 / reach**4, k3 / reach**6)
        camera = _where_it_stays_whole(camera, polynomial=polynomial)
    return camera


def _where_it_stays_whole(camera: Camera, **changes: Any) -> Camera:
    """The camera with changes, unless its image is no longer seen up to its border then."""
    with contextlib.suppress(CameraError):
        changed = dataclasses.replace(camera, **changes)
        border = border_pixels(camera.width, camera.height, 65)
        if np.isfinite(changed.undistort(border)).all():
            return changed
    return camera


def pixel_grid(camera: Camera, along: int = 9) -> NDArray[np.float64]:
    """(along^2, 2) pixels over the whole image, its corners included."""
    u, v = np.meshgrid(
        np.linspace(0, camera.width - 1, along), np.linspace(0, camera.height - 1, along)
    )
    return np.stack([u.ravel(), v.ravel()], axis=-1)
