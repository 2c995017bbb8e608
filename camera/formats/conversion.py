"""Converts a camera to another model: exactly if the model contains it, else by a fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from camera.calibration.model import FreeLens, is_possible, project_points
from camera.errors import CameraError, ConversionError
from camera.formats.models import COEFFICIENTS, P1, ForeignCamera, Model, projected
from camera.model import Camera
from camera.model_checks import LEAST_SEEN_SHARE
from camera.uncertainty import UNPOSED, intrinsics_of, with_intrinsics
from redetect.array_types import FloatArray

#: Deviation (px) up to which a conversion counts as exact: rounding only.
EXACT_PX = 1e-6

# Number of rounds of Lawson's reweighting, which minimises the largest deviation.
_LAWSON_ROUNDS = 25
# Number of rounds of the approximation from which the fit of a wide lens starts.
_RATIONAL_ROUNDS = 5
_STEPS, _LAWSON_STEPS = 60, 5
# Cost of parameters that are impossible or do not see all rays: no step leads there.
_REFUSED_PX = 1e6

AnyCamera = Camera | ForeignCamera
Rows = Literal["same", "halve", "double"]

# From the source's rows to the target's.
_FACTORS = {"same": 1.0, "halve": 0.5, "double": 2.0}

# Grids of pixels: for the fit, and for the largest deviation.
_FIT_GRID, _CHECK_GRID = (41, 31), (129, 97)
# Largest share of pixels that the target need not see at the source's fold.
_AT_FOLD = 0.02
# Largest deviation after least squares above which a fuller model is tried.
_NEAR_PX = 0.02


@dataclass(frozen=True)
class Converted:
    """A converted camera."""

    camera: AnyCamera
    # Largest distance over the image (target's pixels) of a ray's pixels in source and target.
    deviation_px: float
    at: tuple[float, float]  # the target's pixel where it is largest


class CameraFit(NamedTuple):
    """A fit of a camera's (P,) parameters so that rays project close to given pixels."""

    pixels: FloatArray  # (N, 2)
    #: The (N, 2) pixels at which it sees the rays, and their (N, 2, P) derivatives.
    project: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
    possible: Callable[[FloatArray], bool]
    measured: Callable[[FloatArray], Converted]

    def away(self, parameters: FloatArray) -> FloatArray:
        """(N,) distances from the pixels at which it sees the rays; infinite where it does not."""
        found = np.linalg.norm(self.project(parameters)[0] - self.pixels, axis=1)
        return np.where(np.isfinite(found), found, np.inf)

    def fitted(
        self, start: FloatArray, span: FloatArray, weights: FloatArray | None = None
    ) -> FloatArray:
        """(P,) parameters by least squares, which move from a start along a (P, K) span.

        `weights` (N,) are of the squared distances. All steps lead to possible parameters.
        """
        root = np.ones((len(self.pixels), 1)) if weights is None else np.sqrt(weights)[:, None]

        def away(moved: FloatArray) -> FloatArray:
            at = start + span @ moved
            if self.possible(at):
                found = np.asarray(root * (self.project(at)[0] - self.pixels)).ravel()
                if np.all(np.isfinite(found)):
                    return found
            return np.full(self.pixels.size, _REFUSED_PX)

        def jacobian(moved: FloatArray) -> FloatArray:
            by = root[..., None] * (self.project(start + span @ moved)[1] @ span)
            return np.asarray(by).reshape(-1, span.shape[1])

        begin = np.zeros(span.shape[1])
        if away(begin)[0] == _REFUSED_PX:
            return start
        found = least_squares(
            away, begin, jacobian, method="lm", x_scale="jac", ftol=1e-9,
            max_nfev=_STEPS if weights is None else _LAWSON_STEPS,
        )  # fmt: skip
        return np.asarray(start + span @ found.x)


def _nearest(fit: CameraFit, start: FloatArray, spans: Sequence[FloatArray]) -> Converted:
    """The fit with the smallest largest deviation, each span fitted from where the last ended."""
    fits: list[tuple[float, FloatArray, FloatArray]] = []
    parameters = start
    for span in spans:
        parameters = fit.fitted(parameters, span)
        fits.append((float(fit.away(parameters).max()), parameters, span))
        if fits[-1][0] < EXACT_PX:
            break
    _, parameters, span = min(fits, key=lambda found: found[0])
    best = fit.measured(parameters)
    if best.deviation_px < EXACT_PX:
        return best
    return nearer(best, fit.measured(minimax_fit(fit, parameters, span)))


def nearer(*found: Converted) -> Converted:
    """The conversion with the smallest deviation, the first of such."""
    return min(found, key=lambda converted: converted.deviation_px)


def minimax_fit(fit: CameraFit, start: FloatArray, span: FloatArray) -> FloatArray:
    """Parameters with the least maximal distance, by increasing weights where it is large.

    References
    ----------
    Lawson, Contributions to the theory of linear least maximum approximation, 1961.
    """
    weights = np.ones(len(fit.pixels))
    parameters = best = start
    smallest = float("inf")
    for _ in range(_LAWSON_ROUNDS):
        away = fit.away(parameters)
        worst = float(away.max())
        if not np.isfinite(worst):
            break
        if worst < smallest:
            smallest, best = worst, parameters
        if worst < EXACT_PX:
            break
        weights = weights * (0.05 + away / worst)
        weights /= weights.mean()
        parameters = fit.fitted(parameters, span, weights)
    return best


def target_size(source: AnyCamera, rows: Rows) -> tuple[int, int]:
    """Width and height of the target's image."""
    height = source.height
    return source.width, {"same": height, "halve": (height + 1) // 2, "double": 2 * height}[rows]


def convert_to_foreign(
    source: AnyCamera, model: Model, rows: Rows = "same", *, free: int | None = None
) -> Converted:
    """Fit one of the other programs' models.

    Parameters
    ----------
    source : Camera or ForeignCamera
    model : str
        `radtan`, `rational` or `fisheye`.
    rows : str
        `same`, `halve` or `double`.
    free : int, optional
        Number of the model's first coefficients that may differ from 0; by default all.

    Returns
    -------
    Converted

    Raises
    ------
    ConversionError
        If the source sees less than half of its image, or the fit fails.
    """
    number = COEFFICIENTS[model] if free is None else free
    factor = _FACTORS[rows]
    width, height = target_size(source, rows)
    check = _grid(source, rows, _CHECK_GRID)
    held = contained(source, model, number)
    if held is not None:
        fy, cy = held.fy * factor, held.cy * factor
        return _measured(replace(held, width=width, height=height, fy=fy, cy=cy), check)
    pixels, rays = _grid(source, rows, _FIT_GRID)
    fx, fy, cx, cy = source.pinhole
    start = np.array([fx, fy * factor, cx, cy * factor, *[0.0] * COEFFICIENTS[model]])
    if model != "fisheye":
        start[4 + P1 : 4 + P1 + 2] = source.tangential

    def measured(parameters: FloatArray) -> Converted:
        fx, fy, cx, cy, *distortion = parameters.tolist()
        camera = ForeignCamera(model, width, height, fx, fy, cx, cy, tuple(distortion))
        return _measured(camera, check)

    # From few coefficients to all, so that a fit does not start near a wrong minimum.
    counts = sorted({min(count, number) for count in (1, 2, 4, 5, 6, 7, 8)})
    spans = [np.eye(len(start))[:, : 4 + count] for count in counts]
    fit = CameraFit(
        pixels,
        project=lambda parameters: projected(model, parameters, rays)[:2],
        possible=lambda parameters: bool(min(parameters[:2]) > 0.0),
        measured=measured,
    )
    return _nearest(fit, start, spans)


def convert_to_camera(
    source: AnyCamera, rows: Rows = "same", pose: Camera | None = None
) -> Converted:
    """Convert to the project's model, exactly or by a fit.

    A polynomial and tangential terms without a denominator are copied. Otherwise the rational part
    is fitted with the source's tangential terms and, if that is not close enough, all terms and a
    polynomial. Source, rows, result and errors are those of `convert_to_foreign`. The pose,
    ``sensor2Tcp`` and ``mountIndex`` are those of `pose`, else of the source, else the identity.
    The source's covariance is kept with the same rows and pose.
    """
    factor = _FACTORS[rows]
    width, height = target_size(source, rows)
    own = source if isinstance(source, Camera) else UNPOSED
    covariance = own.covariance if rows == "same" and pose is None else None
    pose = own if pose is None else pose
    check = _grid(source, rows, _CHECK_GRID)

    def measured(intrinsics: FloatArray) -> Converted:
        size = {"width": width, "height": height}
        camera = with_intrinsics(
            pose, intrinsics, **size, unknown=own.unknown, covariance=covariance
        )
        return _measured(camera, check)

    fx, fy, cx, cy = source.pinhole
    tangential = source.tangential
    start = np.array([fx, fy * factor, cx, cy * factor, *[0.0] * 5, *tangential, *[0.0] * 3])
    if isinstance(source, Camera):
        start[4:9], start[11:14] = source.coef, source.polynomial
        return measured(start)
    plumb_bob = contained(source, "radtan", COEFFICIENTS["radtan"])
    if plumb_bob is not None:
        k1, k2, _, _, k3 = plumb_bob.distortion
        # One-to-one over its image, but perhaps not over a circle around it, as cameras here are.
        with suppress(CameraError):
            return measured(np.array([*start[:11], k1, k2, k3]))
    pixels, rays = _grid(source, rows, _FIT_GRID)
    points = np.column_stack([rays, np.ones(len(rays))])
    if not is_possible(start, width, height):
        raise ConversionError("the source's focal lengths or principal point are not possible here")
    decentred = any(tangential)
    spans = [FreeLens(count).span(None) for count in range(6)]
    if decentred:
        # Finally, the copied terms may compensate for errors of the radial part.
        spans.append(FreeLens(5, tangential=True).span(None))
    fit = CameraFit(
        pixels,
        project=lambda intrinsics: project_points(intrinsics, points)[:2],
        possible=partial(is_possible, width=width, height=height),
        measured=measured,
    )
    best = _nearest(fit, start, spans)
    if best.deviation_px > _NEAR_PX:  # a wide fisheye lens is too far from a pinhole
        bent = _rational_start(start, pixels, rays)
        if is_possible(bent, width, height):
            best = nearer(best, _nearest(fit, bent, spans[5:]))
    if best.deviation_px <= _NEAR_PX:
        return best
    assert isinstance(best.camera, Camera)
    together = [FreeLens(5, decentred, 3).span(None)]
    return nearer(best, _nearest(fit, intrinsics_of(best.camera), together))


def _rational_start(intrinsics: FloatArray, pixels: FloatArray, rays: FloatArray) -> FloatArray:
    """Intrinsics with a rational part that approximates the radii of (N, 2) pixels and their rays.

    Least squares linear in a2, a3, b1, b2, b3, each time divided by the last denominator (C. K.
    Sanathanan and J. Koerner, Transfer function synthesis as a ratio of two complex polynomials,
    IEEE Transactions on Automatic Control 8, 1963).
    """
    radius = np.hypot(*rays.T)
    added = np.hypot(*((pixels - intrinsics[2:4]) / intrinsics[:2]).T) - radius
    powers = radius[:, None] ** np.arange(1, 4)
    matrix = np.hstack([radius[:, None] * powers[:, :2], -added[:, None] * powers])
    coef, denominator = np.zeros(5), np.ones(len(radius))
    for _ in range(_RATIONAL_ROUNDS):
        weight = 1.0 / np.maximum(denominator, 1.0)
        coef = np.linalg.lstsq(weight[:, None] * matrix, weight * added, rcond=None)[0]
        denominator = 1.0 + powers @ coef[2:]
    return np.concatenate([intrinsics[:4], coef, intrinsics[9:]])


def contained(source: AnyCamera, model: Model, number: int) -> ForeignCamera | None:
    """The source, exactly, in a model with `number` free coefficients, if that contains it."""
    if isinstance(source, Camera):
        if any(source.coef[:2]) or model == "fisheye" or any(source.brown[number:]):
            return None
        distortion = (*source.brown, *(0.0,) * (COEFFICIENTS[model] - len(source.brown)))
        return ForeignCamera(model, source.width, source.height, *source.pinhole, distortion)
    if (source.model == "fisheye") != (model == "fisheye"):
        return None
    count = COEFFICIENTS[model]
    if any(source.distortion[min(count, number) :]):
        return None
    padded = (*source.distortion, *(0.0,) * count)[:count]
    return replace(source, model=model, distortion=padded)


def _grid(source: AnyCamera, rows: Rows, size: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """(N, 2) pixels of the target, denser towards the border, where models part; and their rays.

    Rays are undistorted normalised coordinates of what the source sees there. Pixels that see
    nothing, as in corners past a fold of the distortion, are left out.
    """
    bend = [0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, n)) for n in size]
    axes = [0.5 * b + 0.5 * np.linspace(0.0, 1.0, len(b)) for b in bend]
    width, height = target_size(source, rows)
    u, v = np.meshgrid(axes[0] * (width - 1), axes[1] * (height - 1))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    # Line v of the even lines is line 2 v of all.
    rays = source.undistort(pixels / [1.0, _FACTORS[rows]])
    seen = np.isfinite(rays[:, 0])
    area = np.outer(*(np.gradient(axis) for axis in reversed(axes))).ravel()
    share = area[seen].sum() / area.sum()
    if share < LEAST_SEEN_SHARE:
        raise ConversionError(
            f"only {100.0 * share:.0f} % of the image is seen: expected at least "
            f"{100.0 * LEAST_SEEN_SHARE:.0f} %: the distortion folds inside the image, or the lens "
            "sees 90 degrees and more off its axis"
        )
    return pixels[seen], rays[seen]


def _measured(camera: AnyCamera, check: tuple[FloatArray, FloatArray]) -> Converted:
    pixels, rays = check
    away = np.linalg.norm(camera.distort(rays) - pixels, axis=1)
    unseen = ~np.isfinite(away)
    # If the source folds inside the image, the models differ in how close to the fold they see.
    folds = len(pixels) < np.prod(_CHECK_GRID)
    away[unseen] = 0.0 if folds and np.mean(unseen) < _AT_FOLD else np.inf
    worst = int(np.argmax(away))
    return Converted(camera, float(away[worst]), (float(pixels[worst, 0]), float(pixels[worst, 1])))
