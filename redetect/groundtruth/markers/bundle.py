"""Points seen through chains of poses: fixed and free poses, priors, residuals and derivatives.

The unknowns are poses, not points: a marker's four corners and a board's are rigid and of
known size, which gives the result its scale. Bundle adjusters for reconstruction (as
pycolmap's) move each point independently and cannot keep a square rigid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from redetect.groundtruth.geometry.transforms import exp_se3, inverse, log_se3, right_jacobian
from redetect.groundtruth.markers.chain import (
    ChainPoints,
    project_chain,
    project_chain_with_jacobians,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
PoseKind = Literal["camera", "body", "part"]


@dataclass(frozen=True, eq=False)
class PosePrior:
    """Prior of a pose: its value, and the covariance of right perturbations."""

    kind: PoseKind
    index: int
    pose: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Bundle:
    """Points in images, the poses that they depend on, and which of those are free.

    Attributes
    ----------
    cameras : C cameras
    world_from_camera : (C, 4, 4) float64
    world_from_body : (B, 4, 4) float64
    body_from_part : (P, 4, 4) float64
    free_camera, free_body, free_part : (C | B | P,) bool
    seen : ChainPoints
    view : (N,) int64
        Which part in which image each point is of: 0 to V - 1.
    priors : tuple of PosePrior
        Of free poses.
    """

    cameras: tuple[Camera, ...]
    world_from_camera: FloatArray
    world_from_body: FloatArray
    body_from_part: FloatArray
    free_camera: BoolArray
    free_body: BoolArray
    free_part: BoolArray
    seen: ChainPoints
    view: IntArray
    priors: tuple[PosePrior, ...] = ()

    @property
    def unknowns(self) -> int:
        """Six for each free pose."""
        return 6 * int(self.free_camera.sum() + self.free_body.sum() + self.free_part.sum())

    def only(self, chosen: BoolArray) -> Bundle:
        """The same poses, with the chosen points alone."""
        return replace(self, seen=self.seen.only(chosen), view=self.view[chosen])

    def moved(
        self, camera_steps: FloatArray, body_steps: FloatArray, part_steps: FloatArray
    ) -> Bundle:
        """With free poses moved by right perturbations, (free poses, 6) each."""
        return replace(
            self,
            world_from_camera=_moved(self.world_from_camera, self.free_camera, camera_steps),
            world_from_body=_moved(self.world_from_body, self.free_body, body_steps),
            body_from_part=_moved(self.body_from_part, self.free_part, part_steps),
        )

    def pixels(self) -> FloatArray:
        """(N, 2) pixels at which the points are expected; NaN where they cannot be seen."""
        return project_chain(
            self.cameras,
            self.world_from_camera,
            self.world_from_body,
            self.body_from_part,
            self.seen,
        )


@dataclass(frozen=True, eq=False)
class Whiteners:
    """Whitening of residuals: independent, each of variance 1.

    Attributes
    ----------
    points : (N, 2, 2) float64
        Inverse Cholesky factors of the pixels' covariances.
    priors : tuple of (6, 6) float64
        The same for the priors.
    """

    points: FloatArray
    priors: tuple[FloatArray, ...]

    @classmethod
    def of(cls, bundle: Bundle) -> Whiteners:
        """Those of a bundle."""
        return cls(
            np.asarray(np.linalg.inv(np.linalg.cholesky(bundle.seen.covariances))),
            tuple(np.linalg.inv(np.linalg.cholesky(p.covariance)) for p in bundle.priors),
        )


@dataclass(frozen=True, eq=False)
class Derivatives:
    """How whitened residuals change with right perturbations of the poses they depend on.

    Attributes
    ----------
    by_camera, by_body, by_part : (N, 2, 6) float64
        Of the points' residuals, of fixed poses as well.
    by_prior : tuple of (6, 6) float64
        Of each prior's residuals by its pose.
    """

    by_camera: FloatArray
    by_body: FloatArray
    by_part: FloatArray
    by_prior: tuple[FloatArray, ...]


def whitened_residuals(bundle: Bundle, whiten: Whiteners) -> FloatArray:
    """(2 N + 6 priors,) residuals; NaN where a point cannot be seen."""
    difference = bundle.seen.pixels - bundle.pixels()
    return np.concatenate(
        [
            (whiten.points @ difference[..., None]).ravel(),
            *(
                white @ prior_error(bundle, prior)
                for white, prior in zip(whiten.priors, bundle.priors, strict=True)
            ),
        ]
    )


def whitened_derivatives(bundle: Bundle, whiten: Whiteners) -> Derivatives:
    """The residuals' derivatives, for perturbations of zero."""
    projection = project_chain_with_jacobians(
        bundle.cameras,
        bundle.world_from_camera,
        bundle.world_from_body,
        bundle.body_from_part,
        bundle.seen,
    )
    return Derivatives(
        -(whiten.points @ projection.by_camera),
        -(whiten.points @ projection.by_body),
        -(whiten.points @ projection.by_part),
        tuple(
            white @ np.linalg.inv(right_jacobian(prior_error(bundle, prior)))
            for white, prior in zip(whiten.priors, bundle.priors, strict=True)
        ),
    )


def prior_error(bundle: Bundle, prior: PosePrior) -> FloatArray:
    """(6,) right perturbation that leads from the prior's pose to the bundle's."""
    poses = {
        "camera": bundle.world_from_camera,
        "body": bundle.world_from_body,
        "part": bundle.body_from_part,
    }
    return log_se3(inverse(prior.pose) @ poses[prior.kind][prior.index])


def _moved(poses: FloatArray, free: BoolArray, steps: FloatArray) -> FloatArray:
    if not np.any(free):
        return poses
    moved = poses.copy()
    moved[free] = poses[free] @ exp_se3(steps)
    return moved
