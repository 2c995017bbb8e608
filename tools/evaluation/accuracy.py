"""Accuracy of the places of rendered discs whose truth is exact.

Discs are drawn at random over all pixels that the detector's table covers, at random sub-pixel
places, rendered by exact supersampling (`tools.simulator.single_disc`, which knows nothing of the
detector), and detected. Errors are compared with the covariances that the detector states.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from camera import Camera, read_camera
from detect.circles import detect_circles, vote_shape
from detect.settings import CircleSettings
from lut import cached_vote_table
from lut.outlines import floor_positions, pixels_within, row_step_m
from redetect.array_types import ByteArray, FloatArray
from redetect.landmarks import squared_mahalanobis
from tools.evaluation.figures import Figures, Study
from tools.evaluation.tables import Table
from tools.simulator.pixels import image_of
from tools.simulator.single_disc import render_disc

_BLURS_PX = (0.3, 0.7, 1.2)
#: Grey values of the disc and the floor, and the standard deviation of their noise.
_LIGHT, _DARK, _NOISE = 220.0, 60.0, 2.0
_BINS_M = ((0.0, 1.5), (1.5, 2.5), (2.5, 4.0), (4.0, 7.0))


@dataclass(frozen=True)
class Accuracy:
    """Errors of N fitted discs."""

    distance_m: FloatArray  # (N,) Of the discs from the robot.
    error_px: FloatArray  # (N, 2) Found minus true centre in the image, pixels.
    normalised_error: FloatArray
    """(N,) Squared error over the predicted covariance, per degree of freedom."""
    failed: int  # Discs that were not found.


def measure_accuracy(
    camera: Camera, settings: CircleSettings, *, discs: int, seed: int, blur_px: float = 0.7
) -> Accuracy:
    """Render and detect discs."""
    table = cached_vote_table(camera, vote_shape(settings))
    rng = np.random.default_rng(seed)
    usable = pixels_within(row_step_m(floor_positions(camera)), 6, settings.far_limit_m_per_px)
    rows, columns = np.nonzero(usable)
    distance, error, normalised = [], [], []
    failed = 0
    for index in rng.integers(len(rows), size=discs):
        nearest = np.array([columns[index], rows[index]], np.int64)
        true_xy = camera.floor_from_pixel(nearest + rng.uniform(-0.5, 0.5, 2))
        image = _render(camera, true_xy, settings.radius_m, blur_px, rng)
        found = detect_circles(image, camera, table, settings)
        off = found.floor_xy - true_xy
        if not (np.hypot(*off.T) < 0.5 * settings.radius_m).any():
            failed += 1
            continue
        best = int(np.argmin(np.hypot(*off.T)))
        distance.append(float(np.hypot(*true_xy)))
        error.append(camera.project_floor(found.floor_xy[best]) - camera.project_floor(true_xy))
        normalised.append(squared_mahalanobis(off[best], found.covariance[best]) / 2.0)
    return Accuracy(np.array(distance), np.array(error), np.array(normalised), failed)


def _render(
    camera: Camera, true_xy: FloatArray, radius_m: float, blur_px: float, rng: np.random.Generator
) -> ByteArray:
    """An image of the bare floor with one light disc on it; `blur_px` is the blur along u."""
    grey = _DARK + rng.normal(0.0, _NOISE, (camera.height, camera.width))
    blur = (blur_px, blur_px * camera.scale_y / camera.scale_x)
    crop = render_disc(camera, true_xy, radius_m, _LIGHT, _DARK, blur)
    grey[crop.window] = crop.grey + rng.normal(0.0, _NOISE, crop.grey.shape)
    return image_of(grey)


@dataclass(frozen=True)
class AccuracyStudy(Study):
    """Compare refined centres of rendered single discs with the truth, by blur and distance."""

    camera: Path = Path("images/e/e.cam")  # Calibration for rendering and detection.
    discs: int = 400  # Discs per blur.
    seed: int = 1  # Of positions and noise.

    def measure(self) -> Figures:
        camera = read_camera(self.camera)
        table = Table(
            {"blur px": ".1f", "distance m": "<10", "discs": "d", "rms u px": "9.4f",
             "rms v px": "9.4f", "both px": "8.4f", "normalised": ".3f"}, keys=2
        )  # fmt: skip
        settings = CircleSettings(tilt_sigma_deg=0.0)
        bins = [(f"{low:.1f}-{high:.1f}", low, high) for low, high in _BINS_M]
        for blur_px in _BLURS_PX:
            result = measure_accuracy(
                camera, settings, discs=self.discs, seed=self.seed, blur_px=blur_px
            )
            for label, low, high in [*bins, ("all", 0.0, np.inf)]:
                chosen = (result.distance_m >= low) & (result.distance_m < high)
                if chosen.any():
                    squares = np.mean(result.error_px[chosen] ** 2, axis=0)
                    rms = *np.sqrt(squares), np.sqrt(squares.mean())
                    normalised = result.normalised_error[chosen].mean()
                    table.row(blur_px, label, chosen.sum(), *rms, normalised)
        return {"rendered": self.discs, **table.figures}
