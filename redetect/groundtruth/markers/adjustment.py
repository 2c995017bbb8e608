"""Bundle adjustment of all poses of a chain of cameras, bodies and parts.

    point in the part's frame --body_from_part--> body --world_from_body--> world
          --inverse of world_from_camera--> camera --projection--> pixel

All estimations here have this form. A robot's pose: the body is the robot, its parts are the
markers. A rig: the same with unknown parts. A network of cameras: bodies are the boards held in
front of the cameras, their parts the two faces.

The unknowns are poses, not points: the corners of a marker or board are rigid and of known size,
which gives the result its scale. Bundle adjusters for reconstruction (such as pycolmap's) move each
point independently and cannot keep a square rigid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from camera import Camera
from camera.rotations import cross_matrices
from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.trajectories import se3
from redetect.landmarks import squared_mahalanobis
from redetect.least_squares import solver

UNDETERMINED = "the points do not determine all poses"
# A first, coarse pass has a robust loss.
_ROBUST, _NEAR = solver.Loss("huber", 3.0), 1e-6
_PLAIN, _TOLERANCE = solver.Loss(), 1e-15
# Residuals this many times as large as the median view's are unusual.
_UNUSUAL = 3.0
# Share of the information on the parts' size that is left by rounding if other scales follow it.
_FREE = 1e-9


@dataclass(frozen=True, eq=False)
class ChainPoints:
    """Points seen in images."""

    camera: IntArray  # (N,): indices of each point's camera, body and part
    body: IntArray
    part: IntArray
    points: FloatArray  # (N, 3): in the part's frame (m)
    pixels: FloatArray  # (N, 2): where they were seen, lens distortion included (px)
    covariances: FloatArray  # (N, 2, 2): of the pixels (px^2), positive definite

    def __len__(self) -> int:
        return len(self.camera)

    def only(self, chosen: BoolArray | IntArray) -> ChainPoints:
        """The chosen ones."""
        return ChainPoints(*(getattr(self, field.name)[chosen] for field in fields(self)))


class Chain(NamedTuple):
    """Cameras, bodies and their parts, with the indices used in `ChainPoints`."""

    cameras: Sequence[Camera]  # Their lenses; the mounting of a `Camera` is not used
    world_from_camera: FloatArray  # (C, 4, 4)
    world_from_body: FloatArray  # (B, 4, 4)
    body_from_part: FloatArray  # (P, 4, 4)


class ChainProjection(NamedTuple):
    """Pixels of points and their derivatives by right perturbations of the three poses."""

    pixels: FloatArray  # (N, 2): NaN behind the camera or past the distortion's fold
    by_camera: FloatArray  # (N, 2, 6): d(u, v) / d(translation m, rotation rad)
    by_body: FloatArray
    by_part: FloatArray


def project_chain(chain: Chain, seen: ChainPoints) -> FloatArray:
    """(N, 2) pixels at which the points would be seen (see `ChainProjection.pixels`)."""
    in_body = se3.apply(chain.body_from_part[seen.part], seen.points)
    in_world = se3.apply(chain.world_from_body[seen.body], in_body)
    in_camera = se3.apply(se3.inverse(chain.world_from_camera)[seen.camera], in_world)
    pixels = np.empty((len(seen), 2))
    for index in np.unique(seen.camera):
        chosen = seen.camera == index
        pixels[chosen] = chain.cameras[index].project(in_camera[chosen])
    return pixels


def project_chain_with_jacobians(chain: Chain, seen: ChainPoints) -> ChainProjection:
    """Pixels and Jacobians; parameters as in `project_chain`."""
    camera_from_world = se3.inverse(chain.world_from_camera)[seen.camera]
    camera_from_body = camera_from_world @ chain.world_from_body[seen.body]
    in_body = se3.apply(chain.body_from_part[seen.part], seen.points)
    in_camera = se3.apply(camera_from_body, in_body)
    pixels = np.empty((len(seen), 2))
    by_point = np.empty((len(seen), 2, 3))
    for index in np.unique(seen.camera):
        chosen = seen.camera == index
        pixels[chosen] = chain.cameras[index].project(in_camera[chosen])
        by_point[chosen] = chain.cameras[index].project_jacobian(in_camera[chosen])
    by_body_point = by_point @ camera_from_body[:, :3, :3]
    by_part_point = by_body_point @ chain.body_from_part[seen.part][:, :3, :3]
    return ChainProjection(
        pixels,
        -_by_tangent(by_point, in_camera),
        _by_tangent(by_body_point, in_body),
        _by_tangent(by_part_point, seen.points),
    )


def _by_tangent(by_point: FloatArray, points: FloatArray) -> FloatArray:
    """Chain d(u, v) / d(point) with d(point) / d(v, w) = [I, -[point]x]."""
    return np.concatenate([by_point, -(by_point @ cross_matrices(points))], axis=-1)


@dataclass(frozen=True, eq=False)
class PosePrior:
    """Prior of a pose: its value, and the covariance of right perturbations."""

    index: int  # Of the bundle's poses
    pose: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Bundle:
    """Points in images, the poses that they depend on, and which of those are free."""

    cameras: tuple[Camera, ...]  # C lenses
    parts: int  # P, the number of parts
    poses: FloatArray  # (C + P + B, 4, 4): of cameras, of parts in bodies, of bodies
    free: BoolArray  # (C + P + B,)
    seen: ChainPoints
    view: IntArray  # (N,): which part in which image each point is of: 0 to V - 1
    priors: tuple[PosePrior, ...] = ()  # Of free poses

    @property
    def shared(self) -> int:
        """C + P: how many poses come before those of the bodies."""
        return len(self.cameras) + self.parts

    @property
    def chain(self) -> Chain:
        """Its cameras and poses."""
        cameras, parts, bodies = np.split(self.poses, [len(self.cameras), self.shared])
        return Chain(self.cameras, cameras, bodies, parts)

    @property
    def unknowns(self) -> int:
        """Six for each free pose."""
        return 6 * int(self.free.sum())

    def only(self, chosen: BoolArray) -> Bundle:
        """The same poses, with the chosen points alone."""
        return replace(self, seen=self.seen.only(chosen), view=self.view[chosen])

    def moved(self, step: FloatArray) -> Bundle:
        """With free poses moved by right perturbations."""
        steps = np.zeros((len(self.free), 6))
        steps[self.free] = step.reshape(-1, 6)
        return replace(self, poses=self.poses @ se3.exp(steps))

    def pixels(self) -> FloatArray:
        """(N, 2) pixels at which the points are expected; NaN where they cannot be seen."""
        return project_chain(self.chain, self.seen)

    def prior_error(self, prior: PosePrior) -> FloatArray:
        """(6,) right perturbation that leads from the prior's pose to the bundle's."""
        return se3.log(se3.inverse(prior.pose) @ self.poses[prior.index])


@dataclass(frozen=True, eq=False)
class AdjustedBundle:
    """A bundle at its minimum."""

    bundle: Bundle  # With the adjusted poses
    used: BoolArray  # (N,): points whose views are not outliers
    residuals: FloatArray  # (N, 2): measured minus predicted pixels, of all points
    cost: float  # Squared normalised residuals of the used points and of the priors
    degrees_of_freedom: int
    # (6 (C + P), 6 (C + P)): of right perturbations of cameras and parts, zeros for fixed ones, by
    # the corners' covariances, not scaled by the residuals.
    covariance: FloatArray

    @property
    def camera_covariance(self) -> FloatArray:
        """(6 C, 6 C)."""
        cameras = 6 * len(self.bundle.cameras)
        return self.covariance[:cameras, :cameras]

    @property
    def part_covariance(self) -> FloatArray:
        """(6 P, 6 P)."""
        cameras = 6 * len(self.bundle.cameras)
        return self.covariance[cameras:, cameras:]

    @property
    def chi2_per_dof(self) -> float:
        """Cost over degrees of freedom: 1 if the corners' covariances are right."""
        return self.cost / max(1, self.degrees_of_freedom)

    def residual_figures(self, views: Sequence[int]) -> dict[str, float | None]:
        """Figures of some views: number, outliers, residuals of the others; None without any."""
        chosen = np.isin(self.bundle.view, views)
        residuals = self.residuals[chosen & self.used]
        return {
            "views": len(views),
            "left_out": len(np.unique(self.bundle.view[chosen & ~self.used])),
            "rms_px": float(np.sqrt(np.mean(residuals**2))) if len(residuals) else None,
            "max_px": float(np.linalg.norm(residuals, axis=1).max()) if len(residuals) else None,
        }


def adjust_bundle(
    bundle: Bundle, *, outlier_sigma: float = 5.0, outlier_px: float = 1.0
) -> AdjustedBundle:
    """Adjust all free poses: robustly first, then by least squares without the wrong views.

    The bundle's poses are the start. A view is wrong if its normalised error is larger than
    `outlier_sigma` and its residuals (px) are larger than `outlier_px` and three times the median
    view's. Raises `GeometryError` if the start has a point behind its camera, or the points do not
    determine the poses.
    """
    everything = np.ones(len(bundle.seen), dtype=np.bool_)
    bundle = _minimised(bundle, everything, _ROBUST, _NEAR)
    used = everything
    for _ in range(5):
        errors, rms = _view_figures(bundle)
        # Corners may be less accurate than stated, all of them.
        least_px = max(outlier_px, _UNUSUAL * float(np.median(rms)))
        wrong = (errors > outlier_sigma) & (rms > least_px)
        kept = ~wrong[bundle.view]
        if np.array_equal(kept, used) and used is not everything:
            break
        used = kept
        # A body without used points is not moved.
        free = bundle.free.copy()
        bodies = np.arange(len(free) - bundle.shared)
        free[bundle.shared :] &= np.isin(bodies, bundle.seen.body[used])
        bundle = _minimised(replace(bundle, free=free), used, _PLAIN, _TOLERANCE)
    problem = linearised(bundle.only(used))
    at = np.flatnonzero(np.repeat(bundle.free[: bundle.shared], 6))
    covariance = np.zeros((6 * bundle.shared, 6 * bundle.shared))
    covariance[np.ix_(at, at)] = inverted_information(_shared_information(problem, len(at)))
    return AdjustedBundle(
        bundle,
        used,
        bundle.seen.pixels - bundle.pixels(),
        float(problem.residual @ problem.residual),
        len(problem.residual) - bundle.unknowns,
        covariance,
    )


def linearised(bundle: Bundle, loss: solver.Loss = _PLAIN) -> solver.Linear:
    """The problem near a bundle's poses; the unknowns are right perturbations, ordered as `free`.

    Residuals are in standard deviations: those of the points, then those of the priors.
    """
    seen, free = bundle.seen, bundle.free
    projection = project_chain_with_jacobians(bundle.chain, seen)
    unknown = np.where(free, 6 * (np.cumsum(free) - 1), -1)
    white = solver.whitening(seen.covariances)
    derivatives = [
        (unknown[seen.camera], -white @ projection.by_camera),
        (unknown[len(bundle.cameras) + seen.part], -white @ projection.by_part),
        (unknown[bundle.shared + seen.body], -white @ projection.by_body),
    ]
    residuals = (white @ (seen.pixels - projection.pixels)[..., None])[..., 0]
    blocks = [solver.Block(residuals, derivatives, loss=loss)]
    for prior in bundle.priors:
        error, root = bundle.prior_error(prior), solver.whitening(prior.covariance)
        by_pose = root @ np.linalg.inv(se3.right_jacobian(error))
        at = unknown[prior.index : prior.index + 1]
        blocks.append(solver.Block((root @ error)[None], [(at, by_pose[None])]))
    return solver.stack(blocks, bundle.unknowns, 0)


class _Adjustment(NamedTuple):
    """The sum of squares of a bundle as `redetect.least_squares.solver.minimise` takes it."""

    loss: solver.Loss

    def cost(self, at: Bundle) -> float:
        off = at.seen.pixels - at.pixels()
        residuals = (solver.whitening(at.seen.covariances) @ off[..., None])[..., 0]
        priors = [solver.whitening(p.covariance) @ at.prior_error(p) for p in at.priors]
        parts = [(residuals, self.loss), *((prior[None], _PLAIN) for prior in priors)]
        return solver.robust_cost(parts)

    def linear(self, at: Bundle) -> solver.Linear:
        return linearised(at, self.loss)

    def moved(self, at: Bundle, step: FloatArray, _: FloatArray) -> Bundle:
        return at.moved(step)


def _minimised(bundle: Bundle, used: BoolArray, loss: solver.Loss, tolerance: float) -> Bundle:
    """The bundle at the minimum of the used points' cost."""
    if bundle.unknowns == 0:
        return bundle
    part = bundle.only(used)
    residuals = 2 * len(part.seen) + 6 * len(part.priors)
    if residuals < bundle.unknowns:
        raise GeometryError(
            f"{residuals} residuals for {bundle.unknowns} unknowns: too little was seen"
        )
    try:
        part = solver.minimise(_Adjustment(loss), part, tolerance=tolerance).at
    except solver.StartError:
        raise GeometryError("the start has a point behind its camera or outside its lens") from None
    except np.linalg.LinAlgError:
        raise GeometryError(UNDETERMINED) from None
    return replace(part, seen=bundle.seen, view=bundle.view)


def _view_figures(bundle: Bundle) -> tuple[FloatArray, FloatArray]:
    """Each view's normalised error, and its root mean square residual in pixels."""
    difference = bundle.seen.pixels - bundle.pixels()
    count = 2 * np.maximum(np.bincount(bundle.view), 1)
    squares = squared_mahalanobis(difference, bundle.seen.covariances)
    errors = np.sqrt(np.bincount(bundle.view, squares) / count)
    rms = np.sqrt(np.bincount(bundle.view, np.sum(difference**2, axis=1)) / count)
    return np.nan_to_num(errors, nan=np.inf), np.nan_to_num(rms, nan=np.inf)


def size_of_parts(adjusted: AdjustedBundle) -> tuple[float, float]:
    """Factor of the size of all parts that would fit the images best, linearised, and its standard
    deviation, scaled by the residuals; infinite if the images do not determine it.
    """
    part = adjusted.bundle.only(adjusted.used)
    by_part = project_chain_with_jacobians(part.chain, part.seen).by_part
    by_size = by_part[..., :3] @ part.seen.points[..., None]
    problem = linearised(part)
    border = np.zeros((len(problem.residual), 1))
    border[: by_size.size] = -(solver.whitening(part.seen.covariances) @ by_size).reshape(-1, 1)
    normal = solver.normal_equations(problem._replace(border=border))
    eliminated = solver.factor(normal.matrix).solve(normal.border)
    information = float((normal.corner - normal.border.T @ eliminated)[0, 0])
    if information < _FREE * float(normal.corner[0, 0]):
        return 1.0, np.inf
    _, change = normal.step(0.0)
    return 1.0 + float(change[0]), float(np.sqrt(max(1.0, adjusted.chi2_per_dof) / information))


def _shared_information(problem: solver.Linear, shared: int) -> FloatArray:
    """Inverse covariance of the first unknowns, those of cameras and parts; bodies marginalised.

    No two bodies share a residual, so that their part of the normal equations is sparse (Triggs et
    al., Bundle Adjustment - A Modern Synthesis, 2000, section 6).
    """
    normal = solver.normal_equations(problem).matrix
    information, coupling = normal[:shared, :shared].toarray(), normal[shared:, :shared].toarray()
    if not len(coupling):
        return np.asarray(information)
    try:
        bodies = solver.factor(normal[shared:, shared:].tocsc())
    except np.linalg.LinAlgError:
        raise GeometryError(UNDETERMINED) from None
    return np.asarray(information - coupling.T @ bodies.solve(coupling))


def inverted_information(information: FloatArray) -> FloatArray:
    """Covariance of an information matrix."""
    if not len(information):
        return information
    scale = np.sqrt(np.clip(np.diagonal(information), 0.0, None))
    if not np.all(scale > 0.0):
        raise GeometryError(UNDETERMINED)
    normalised = information / scale[:, None] / scale[None, :]
    if np.linalg.eigvalsh(normalised)[0] < 1e-12:
        raise GeometryError(UNDETERMINED)
    covariance = np.linalg.inv(normalised) / scale[:, None] / scale[None, :]
    return np.asarray(0.5 * (covariance + covariance.T))
