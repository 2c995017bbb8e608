"""Uncertainty of a calibration's projections, and differences between those of two cameras.

A small rotation of the camera has the same effect as a shift of the principal point, and the pose
absorbs it; so the component common with a rotation is removed, as in mrcal.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera.calibration.model import COUNT, cross_matrices, project_points
from camera.model import Camera, Pose

FloatArray = NDArray[np.float64]

IDENTITY: Pose = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
#: A camera without a pose, to be given intrinsics.
UNPOSED = Camera(1, 1, 1.0, 1.0, 0.0, 0.0, (0.0,) * 5, IDENTITY, IDENTITY)


def pixel_grid(width: int, height: int, columns: int = 49, rows: int = 37) -> FloatArray:
    """(rows * columns, 2) pixels from corner to corner of an image."""
    u, v = np.meshgrid(np.linspace(0.0, width - 1.0, columns), np.linspace(0.0, height - 1.0, rows))
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def intrinsics_of(camera: Camera) -> FloatArray:
    """(14,) numbers of a camera (`calibration_model.INTRINSICS`)."""
    pinhole = (camera.scale_x, camera.scale_y, camera.offset_x, camera.offset_y)
    return np.array([*pinhole, *camera.coef, *camera.tangential, *camera.polynomial])


def with_intrinsics(camera: Camera, intrinsics: FloatArray, **changes: Any) -> Camera:
    """The camera with other intrinsics, an array as of `intrinsics_of`, and other changes."""
    sx, sy, ox, oy, a2, a3, b1, b2, b3, p1, p2, k1, k2, k3 = (float(x) for x in intrinsics)
    return replace(
        camera, scale_x=sx, scale_y=sy, offset_x=ox, offset_y=oy, coef=(a2, a3, b1, b2, b3),
        tangential=(p1, p2), polynomial=(k1, k2, k3), **changes,
    )  # fmt: skip


def projection_sigma(
    camera: Camera, covariance: FloatArray, columns: int = 49, rows: int = 37
) -> FloatArray:
    """Standard deviation of where directions are projected, whatever the camera's rotation.

    Root of the trace of each pixel's covariance (u and v together), (rows, columns) pixels, by the
    (14, 14) covariance of the intrinsics.
    """
    rays = camera.unproject(pixel_grid(camera.width, camera.height, columns, rows))
    _, by_intrinsics, by_point = project_points(intrinsics_of(camera), rays)
    J = by_intrinsics.reshape(-1, COUNT)
    turn = (-by_point @ cross_matrices(rays)).reshape(-1, 3)
    J = J - turn @ np.linalg.lstsq(turn, J, rcond=None)[0]
    variance = np.einsum("ni,ij,nj->n", J, covariance, J).reshape(-1, 2).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)).reshape(rows, columns))
