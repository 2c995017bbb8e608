"""Accuracy of the disc fit on rendered discs whose truth is exact.

Discs are drawn at random over all pixels that the detector's table covers, at random sub-pixel
places, rendered by exact supersampling (`tools.simulator.single_disc`, which knows nothing of the
fit), and fitted. Errors are held against the covariance that the fit predicts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from camera import Camera, read_camera
from detect.circles import disc_shape, refined_covariance
from detect.discs.fit import blur_ratio_of, fit_discs
from detect.grey_values import estimate_noise
from detect.settings import CircleSettings
from lut import DiscTable, cached_disc_table
from tools.arrays import ByteArray, FloatArray
from tools.evaluation.tables import Table
from tools.simulator.single_disc import render_disc

_BLURS_PX = (0.3, 0.7, 1.2)
_BINS_M = ((0.0, 1.5), (1.5, 2.5), (2.5, 4.0), (4.0, 7.0))


@dataclass(frozen=True)
class Accuracy:
    """Errors of N fitted discs."""

    distance_m: FloatArray  # (N,) Of the discs from the robot.
    error_px: FloatArray  # (N, 2) Fitted minus true centre in the image, pixels.
    normalised_error: FloatArray
    """(N,) Squared error over the predicted covariance, per degree of freedom."""
    failed: int  # Discs that the fit gave up.

    @property
    def rms_px(self) -> float:
        """Root mean square of the errors of either coordinate, pixels."""
        return float(np.sqrt(np.mean(self.error_px**2)))


def measure_accuracy(
    camera: Camera,
    settings: CircleSettings,
    *,
    discs: int,
    light: float,
    dark: float,
    blur_px: float,
    noise: float,
    seed: int,
) -> Accuracy:
    """Render and fit discs."""
    table = cached_disc_table(camera, disc_shape(replace(settings, rows_apart=0.0)))
    rng = np.random.default_rng(seed)
    rows, columns = np.nonzero(table.usable)
    distance, error, normalised = [], [], []
    failed = 0
    for index in rng.integers(len(rows), size=discs):
        pixel = np.array([columns[index], rows[index]]) + rng.uniform(-0.5, 0.5, 2)
        true_xy = camera.floor_from_pixel(pixel)
        image = _render(camera, table, true_xy, settings, light, dark, blur_px, noise, rng)
        nearest = np.array([[columns[index], rows[index]]], np.int64)
        fit = fit_discs(
            image,
            table.floor_xy,
            nearest,
            settings.radius_m,
            estimate_noise(image),
            blur_ratio=blur_ratio_of(camera),
        )
        if not fit.fitted[0]:
            failed += 1
            continue
        covariance = refined_covariance(camera, fit.floor_xy, fit.covariance, settings)[0]
        off = fit.floor_xy[0] - true_xy
        distance.append(float(np.hypot(*true_xy)))
        error.append(camera.project_floor(fit.floor_xy[0]) - camera.project_floor(true_xy))
        normalised.append(float(off @ np.linalg.solve(covariance, off)) / 2.0)
    return Accuracy(np.array(distance), np.array(error), np.array(normalised), failed)


def _render(
    camera: Camera,
    table: DiscTable,
    true_xy: FloatArray,
    settings: CircleSettings,
    light: float,
    dark: float,
    blur_px: float,
    noise: float,
    rng: np.random.Generator,
) -> ByteArray:
    """An image of the bare floor with one disc on it."""
    height, width = table.usable.shape
    floor = dark + rng.normal(0.0, noise, (height, width))
    image = np.clip(np.rint(floor), 0, 255).astype(np.uint8)
    blur = (blur_px, blur_px * camera.scale_y / camera.scale_x)
    crop = render_disc(camera, true_xy, settings.radius_m, light, dark, blur, noise, rng=rng)
    top, left = max(crop.v0, 0), max(crop.u0, 0)
    bottom = min(crop.v0 + crop.grey.shape[0], height)
    right = min(crop.u0 + crop.grey.shape[1], width)
    image[top:bottom, left:right] = crop.grey[
        top - crop.v0 : bottom - crop.v0, left - crop.u0 : right - crop.u0
    ]
    return image


@dataclass(frozen=True)
class AccuracyStudy:
    """Refined centres of rendered single discs against the truth, by blur and distance."""

    camera: Path = Path("images/e/e.cam")  # Calibration to render and fit through.
    discs: int = 400  # Discs per blur.
    light: float = 220.0  # Grey value of the discs.
    dark: float = 60.0  # Grey value of the floor.
    noise: float = 2.0  # Standard deviation of the noise, grey levels.
    seed: int = 1  # Of places and noise.

    def __call__(self) -> int:
        camera = read_camera(self.camera)
        table = Table(
            {"blur px": ".1f", "distance m": "<10", "discs": "d", "rms u px": "9.4f",
             "rms v px": "9.4f", "normalised error^2 / dof": ".3f"}
        )  # fmt: skip
        for blur_px in _BLURS_PX:
            result = measure_accuracy(
                camera, CircleSettings(tilt_sigma_deg=0.0), discs=self.discs, light=self.light,
                dark=self.dark, blur_px=blur_px, noise=self.noise, seed=self.seed,
            )  # fmt: skip
            bins = [(f"{low:.1f}-{high:.1f}", low, high) for low, high in _BINS_M]
            for label, low, high in [*bins, ("all", 0.0, np.inf)]:
                chosen = (result.distance_m >= low) & (result.distance_m < high)
                if chosen.any():
                    rms = np.sqrt(np.mean(result.error_px[chosen] ** 2, axis=0))
                    normalised = result.normalised_error[chosen].mean()
                    table.row(blur_px, label, chosen.sum(), *rms, normalised)
            print(f"both coordinates {result.rms_px:.4f} px rms, {result.failed} failed")
        return 0
