"""Converts a camera to another model: exactly if the model contains it, else by a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera.calibration.model import free_span, is_possible, project_points
from camera.distortion import NOT_TANGENTIAL, Tangential
from camera.errors import CameraError, ConversionError
from camera.formats.models import COEFFICIENTS, P1, ForeignCamera, Model, distorted
from camera.model import Camera
from camera.uncertainty import UNPOSED, intrinsics_of, with_intrinsics
from redetect.least_squares.solver import (
    Block,
    Linear,
    Loss,
    StartError,
    minimise,
    robust_cost,
    stack,
)

FloatArray = NDArray[np.float64]
Projection = Callable[[FloatArray], tuple[FloatArray, FloatArray]]

#: Deviation (px) up to which a conversion counts as exact: rounding only.
EXACT_PX = 1e-6

# Number of rounds of Lawson's reweighting, which minimises the largest deviation.
_LAWSON_ROUNDS = 25
_STEPS = 60
_LAWSON_STEPS = 5


class CameraFit(NamedTuple):
    """Parameters of a camera that sees rays nearest to pixels; as the solver takes it."""

    project: Projection  # from parameters to the (N, 2) pixels of the rays, and (N, 2, P) Jacobians
    span: FloatArray  # (P, K) free directions
    pixels: FloatArray  # (N, 2)
    possible: Callable[[FloatArray], bool]
    weights: FloatArray | None = None  # (N,) of the squared distances

    def fitted(self, start: FloatArray, steps: int = _STEPS) -> FloatArray:
        """(P,) parameters, from a start on; all steps lead to possible ones."""
        try:
            return minimise(self, start, tolerance=1e-9, most_steps=steps, damping=1e-4).at
        except StartError:
            return start

    def cost(self, at: FloatArray) -> float:
        if not self.possible(at):
            return float("inf")
        return robust_cost([(self._root() * (self.project(at)[0] - self.pixels), Loss())])

    def linear(self, at: FloatArray) -> Linear:
        found, jacobian = self.project(at)
        by = self._root()[:, :, None] * (jacobian @ self.span)
        every = np.zeros(len(found), dtype=np.int64)
        block = Block(self._root() * (found - self.pixels), [(every, by)])
        return stack([block], self.span.shape[1], 0)

    def moved(self, at: FloatArray, step: FloatArray, shared: FloatArray) -> FloatArray:
        return np.asarray(at + self.span @ step)

    def _root(self) -> FloatArray:
        weights = np.ones(len(self.pixels)) if self.weights is None else self.weights
        return np.sqrt(weights)[:, None]


def smallest_largest(fit: CameraFit, start: FloatArray) -> FloatArray:
    """Parameters towards the smallest largest distance: weights grow where it is large.

    References
    ----------
    Lawson, Contributions to the theory of linear least maximum approximation, 1961.
    """
    weights = np.ones(len(fit.pixels))
    parameters = best = start
    smallest = float("inf")
    for _ in range(_LAWSON_ROUNDS):
        away = np.linalg.norm(fit.project(parameters)[0] - fit.pixels, axis=1)
        worst = float(away.max())
        if not np.isfinite(worst):
            break
        if worst < smallest:
            smallest, best = worst, parameters
        if worst < EXACT_PX:
            break
        weights = weights * (0.05 + away / worst)
        weights /= weights.mean()
        parameters = fit._replace(weights=weights).fitted(parameters, _LAWSON_STEPS)
    return best


AnyCamera = Camera | ForeignCamera
Rows = Literal["same", "halve", "double"]

# From the source's rows to the target's.
_FACTORS = {"same": 1.0, "halve": 0.5, "double": 2.0}

# Grids of pixels: for the fit, and for the largest deviation.
_FIT_GRID = (41, 31)
_CHECK_GRID = (129, 97)
# The rational model's coefficients before those of the thin prism.
_WITHOUT_PRISM = 8
# A largest deviation after least squares from which on a fuller model is tried.
_NEAR_PX = 0.02


@dataclass(frozen=True)
class Converted:
    """A converted camera."""

    camera: AnyCamera
    # Largest distance, over the image, between where a pixel's ray is seen by the source and by the
    # target (target's pixels).
    deviation_px: float
    at: tuple[float, float]  # the target's pixel where it is largest


def target_size(source: AnyCamera, rows: Rows) -> tuple[int, int]:
    """Width and height of the target's image."""
    if rows == "halve":
        return source.width, (source.height + 1) // 2
    return source.width, source.height * (2 if rows == "double" else 1)


def source_pixels(pixels: FloatArray, rows: Rows) -> FloatArray:
    """The source's pixels of the target's: line v of the even lines is line 2 v of all."""
    return np.asarray(pixels / [1.0, _FACTORS[rows]])


def convert_to_foreign(
    source: AnyCamera, model: Model, rows: Rows = "same", *, free: int = -1
) -> Converted:
    """Fit one of the other programs' models.

    Parameters
    ----------
    source : Camera or ForeignCamera
    model : str
        `radtan`, `rational` or `fisheye`.
    rows : str
        `same`, `halve` or `double`.
    free : int
        Number of the model's first coefficients that may differ from 0; -1: all. A thin prism's are
        taken over, but never fitted.

    Returns
    -------
    Converted

    Raises
    ------
    ConversionError
        If the source does not see all of its image, or the fit fails.
    """
    number = COEFFICIENTS[model] if free < 0 else free
    contained = _contained(source, model, number)
    if model == "rational":
        number = min(number, _WITHOUT_PRISM)
    width, height = target_size(source, rows)
    factor = _FACTORS[rows]
    if contained is not None:
        fy, cy = contained.fy * factor, contained.cy * factor
        exact = replace(contained, width=width, height=height, fy=fy, cy=cy)
        return _measured(exact, _check(source, rows))
    check = _check(source, rows)
    pixels = _grid(width, height, _FIT_GRID)
    rays = _rays(source, source_pixels(pixels, rows))
    fx, fy, cx, cy = _pinhole(source)
    start = np.concatenate([[fx, fy * factor, cx, cy * factor], np.zeros(COEFFICIENTS[model])])
    if model != "fisheye":
        start[4 + P1 : 4 + P1 + 2] = _tangential(source)

    def camera_of(parameters: FloatArray) -> ForeignCamera:
        fx, fy, cx, cy, *distortion = (float(value) for value in parameters)
        return ForeignCamera(model, width, height, fx, fy, cx, cy, tuple(distortion))

    def project(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        camera = _unchecked(model, parameters)
        found = camera(rays)
        jacobian = np.empty((*found.shape, len(parameters)))
        for k in range(len(parameters)):
            step = 1e-6 * max(abs(parameters[k]), 1.0)
            moved = parameters.copy()
            moved[k] += step
            ahead = _unchecked(model, moved)(rays)
            moved[k] -= 2.0 * step
            jacobian[..., k] = (ahead - _unchecked(model, moved)(rays)) / (2.0 * step)
        return found, jacobian

    def possible(parameters: FloatArray) -> bool:
        return bool(min(parameters[:2]) > 0.0)

    every = np.eye(len(start))
    spans = [every[:, : 4 + count] for count in _stages(model, number)]
    fit = CameraFit(project, every, pixels, possible)
    best = _nearest(fit, camera_of, start, spans, check)
    if best is None:
        raise ConversionError(f"no {model} camera sees what the source sees")
    return best


def contains(model: Model, source: AnyCamera, *, free: int = -1) -> bool:
    """Whether a model represents a camera exactly; parameters as of `convert_to_foreign`."""
    return _contained(source, model, COEFFICIENTS[model] if free < 0 else free) is not None


def convert_to_camera(
    source: AnyCamera, rows: Rows = "same", pose: Camera | None = None
) -> Converted:
    """Convert to the project's model, exactly or by a fit.

    A polynomial and tangential terms without a denominator are copied. Else the
    rational part is fitted beside the source's tangential terms and, where it comes not near, all
    of them and a polynomial together.

    Parameters
    ----------
    source : Camera or ForeignCamera
    rows : str
        `same`, `halve` or `double`.
    pose : Camera, optional
        Whose ``sensor2World``, ``sensor2Tcp`` and ``mountIndex`` the result gets; by default those
        of the source if it has them, else the identity.

    Returns
    -------
    Converted

    Raises
    ------
    ConversionError
        If the source does not see all of its image, or the fit fails.
    """
    width, height = target_size(source, rows)
    if pose is None and isinstance(source, Camera):
        pose = source
    factor = _FACTORS[rows]

    base = pose if pose is not None else UNPOSED
    unknown = source.unknown if isinstance(source, Camera) else ()

    def camera_of(intrinsics: FloatArray) -> Camera:
        return with_intrinsics(
            base, intrinsics, width=width, height=height, unknown=unknown, covariance=None
        )

    fx, fy, cx, cy = _pinhole(source)
    start = np.array(
        [fx, fy * factor, cx, cy * factor, *[0.0] * 5, *_tangential(source), *[0.0] * 3]
    )
    check = _check(source, rows)
    if isinstance(source, Camera):
        start[4:9], start[11:14] = source.coef, source.polynomial
        return _measured(camera_of(start), check)
    plumb_bob = _contained(source, "radtan", COEFFICIENTS["radtan"])
    if plumb_bob is not None:
        k1, k2, _, _, k3 = plumb_bob.distortion
        try:
            return _measured(camera_of(np.array([*start[:11], k1, k2, k3])), check)
        except CameraError:
            # One-to-one over its image, but not over a circle around it, as cameras here are.
            pass
    pixels = _grid(width, height, _FIT_GRID)
    rays = _rays(source, source_pixels(pixels, rows))
    points = np.column_stack([rays, np.ones(len(rays))])

    def project(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        found, by_intrinsics, _ = project_points(parameters, points)
        return found, by_intrinsics

    def possible(p: FloatArray) -> bool:
        return is_possible(p, width, height)

    if not possible(start):
        raise ConversionError("the source's focal lengths or principal point are not possible here")
    spans = [free_span(count, None) for count in range(6)]
    if any(_tangential(source)):
        # Finally, the copied terms may compensate for what the radial part cannot follow.
        spans.append(free_span(5, None, tangential=True))
    together = free_span(5, None, tangential=any(_tangential(source)), polynomial=3)
    fit = CameraFit(project, together, pixels, possible)
    best = _nearest(fit, camera_of, start, spans, check)
    if best is None or best.deviation_px > _NEAR_PX:
        nearest = start if best is None else _intrinsics(best)
        fuller = _nearest(fit, camera_of, nearest, [together], check)
        if best is None or (fuller is not None and fuller.deviation_px < best.deviation_px):
            best = fuller
    if best is None:
        raise ConversionError("no camera of the project's model sees what the source sees")
    return best


def _intrinsics(found: Converted) -> FloatArray:
    assert isinstance(found.camera, Camera)
    return intrinsics_of(found.camera)


def _nearest(
    fit: CameraFit,
    camera_of: Callable[[FloatArray], AnyCamera],
    start: FloatArray,
    spans: list[FloatArray],
    check: tuple[FloatArray, FloatArray],
) -> Converted | None:
    """The fit with the smallest largest deviation, each span fitted from where the last ended."""
    best: Converted | None = None
    nearest = parameters = start

    def keep(candidate: FloatArray) -> bool:
        nonlocal best
        try:
            converted = _measured(camera_of(candidate), check)
        except CameraError:
            return False
        if best is None or converted.deviation_px < best.deviation_px:
            best = converted
            return True
        return False

    span = spans[0]
    for wider in spans:
        parameters = fit._replace(span=wider).fitted(parameters)
        if keep(parameters):
            nearest, span = parameters, wider
        if best is not None and best.deviation_px < EXACT_PX:
            return best
    keep(smallest_largest(fit._replace(span=span), nearest))
    return best


def _unchecked(model: Model, p: FloatArray) -> Callable[[FloatArray], FloatArray]:
    def project(rays: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):
            return np.asarray(distorted(model, p[4:], rays) * p[:2] + p[2:4])

    return project


def _stages(model: Model, number: int) -> list[int]:
    """Numbers of free coefficients, from few to all: so a fit does not start in a wrong valley."""
    return sorted({min(n, number) for n in (1, 2, 4, 5, 6, 7, 8, number)}) if number else [0]


def _contained(source: AnyCamera, model: Model, number: int) -> ForeignCamera | None:
    """The source itself in the target's model, where that holds it."""
    if isinstance(source, Camera):
        if any(source.coef[:2]) or model == "fisheye" or any(source.brown[number:]):
            return None
        fx, fy, cx, cy = _pinhole(source)
        distortion = np.zeros(COEFFICIENTS[model])
        distortion[: len(source.brown)] = source.brown
        found = tuple(distortion.tolist())
        return ForeignCamera(model, source.width, source.height, fx, fy, cx, cy, found)
    if (source.model == "fisheye") != (model == "fisheye"):
        return None
    count = COEFFICIENTS[model]
    padded = (*source.distortion, *(0.0,) * count)[:count]
    if any(source.distortion[count:]) or any(padded[number:]):
        return None
    return replace(source, model=model, distortion=padded)


def _tangential(source: AnyCamera) -> Tangential:
    """p1 and p2, which mean the same in all models that have them."""
    if isinstance(source, Camera):
        return source.tangential
    if source.model == "fisheye":
        return NOT_TANGENTIAL
    return source.distortion[P1], source.distortion[P1 + 1]


def _pinhole(source: AnyCamera) -> tuple[float, float, float, float]:
    if isinstance(source, Camera):
        return source.scale_x, source.scale_y, source.offset_x, source.offset_y
    return source.fx, source.fy, source.cx, source.cy


def _grid(width: int, height: int, size: tuple[int, int]) -> FloatArray:
    """(N, 2) pixels from corner to corner, denser towards the border, where models part."""
    bend = [0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, n)) for n in size]
    axes = [0.5 * b + 0.5 * np.linspace(0.0, 1.0, len(b)) for b in bend]
    u, v = np.meshgrid(axes[0] * (width - 1), axes[1] * (height - 1))
    return np.asarray(np.stack([u, v], axis=-1).reshape(-1, 2))


def _rays(source: AnyCamera, pixels: FloatArray) -> FloatArray:
    """(N, 2) undistorted normalised coordinates of the source's pixels."""
    rays = source.undistort(pixels)
    if not np.all(np.isfinite(rays)):
        u, v = pixels[int(np.argmax(~np.isfinite(rays[:, 0])))]
        raise ConversionError(f"the source sees nothing at pixel ({u:.6g}, {v:.6g})")
    return rays


def _check(source: AnyCamera, rows: Rows) -> tuple[FloatArray, FloatArray]:
    """The target's pixels at which the deviation is evaluated, and their rays."""
    pixels = _grid(*target_size(source, rows), _CHECK_GRID)
    return pixels, _rays(source, source_pixels(pixels, rows))


def _measured(camera: AnyCamera, check: tuple[FloatArray, FloatArray]) -> Converted:
    pixels, rays = check
    away = np.linalg.norm(camera.distort(rays) - pixels, axis=1)
    away = np.where(np.isfinite(away), away, np.inf)
    worst = int(np.argmax(away))
    return Converted(camera, float(away[worst]), (float(pixels[worst, 0]), float(pixels[worst, 1])))
