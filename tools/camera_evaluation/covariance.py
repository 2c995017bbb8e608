"""Whether the predicted covariance of a calibration is right, by Monte Carlo.

Example: python -m tools.camera_evaluation covariance images/e/e.cam --trials 100
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from tyro.conf import Positional

from camera import Camera, read_camera
from camera.boards.board import Board
from camera.calibration.adjustment import Estimate, Points
from camera.calibration.fit import circle_shifts, fit_points
from camera.calibration.model import INTRINSICS
from camera.calibration.projection import intrinsics_of
from camera.calibration.settings import CalibrationSettings, FreeLens
from tools.camera_evaluation.rendered import BOARDS
from tools.camera_evaluation.rendering import board_poses

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Trials:
    """Results of repeated calibrations.

    Attributes
    ----------
    errors : (T, 14) float64
        Estimated less true intrinsics.
    covariances : (T, 14, 14) float64
        As predicted.
    nees : (T,) float64
        Normalised squared errors of the projection, over its free directions; `freedom` on average.
    freedom : int
    """

    errors: FloatArray
    covariances: FloatArray
    nees: FloatArray
    freedom: int


def monte_carlo(
    camera: Camera,
    board: Board,
    *,
    views: int,
    trials: int,
    sigma_px: float,
    seed: int,
    distances_m: tuple[float, float] = (0.2, 0.45),
    outliers: float = 0.0,
    seen: float = 1.0,
) -> Trials:
    """Calibrate again and again from the same poses with new noise.

    Parameters
    ----------
    camera : Camera
        The truth; scaleY / scaleX is taken as known. Tangential terms are free if it has some.
    board : Board
    views, trials : int
    sigma_px : float
        Noise of a coordinate.
    seed : int
    distances_m : (float, float)
        Of the boards.
    outliers : float
        Share of points that are 20 standard deviations off.
    seen : float
        Share of each board's points that are seen, others in every picture.
    """
    poses = board_poses(camera, board, views, seed, distances_m=distances_m)
    truth = Estimate(
        intrinsics_of(camera), np.stack([R for R, _ in poses]), np.stack([t for _, t in poses])
    )
    rng = np.random.default_rng(seed + 1)
    count = max(round(seen * len(board.points)), 6)
    chosen = np.stack([np.sort(rng.choice(len(board.points), count, replace=False)) for _ in poses])
    exact = Points(
        board.points[chosen].reshape(-1, 3),
        np.concatenate(
            [camera.project(board.points[k] @ R.T + t) for k, (R, t) in zip(chosen, poses)]
        ),
        np.arange(views) * count,
        camera.width,
        camera.height,
    )
    radius_m = 0.5 * board.circle_m
    pixels = exact.pixels + (circle_shifts(truth, exact, radius_m) if radius_m > 0.0 else 0.0)
    aspect = camera.scale_y / camera.scale_x
    lens, settings = FreeLens(5, camera.decentred), CalibrationSettings(aspect=aspect)
    span = lens.span(aspect)
    errors, covariances, nees = [], [], []
    for _ in range(trials):
        noise = rng.normal(scale=sigma_px, size=pixels.shape)
        wrong = rng.random(len(pixels)) < outliers
        noise[wrong] += 20.0 * sigma_px * rng.normal(size=(int(wrong.sum()), 2))
        points = replace(exact, pixels=pixels + noise)
        fit, _ = fit_points(truth, points, settings, lens, radius_m)
        error = fit.estimate.intrinsics - truth.intrinsics
        free = np.linalg.pinv(span)
        reduced = free @ fit.covariance @ free.T
        errors.append(error)
        covariances.append(fit.covariance)
        scale = np.sqrt(np.diag(reduced))
        whitened = (free @ error) / scale
        nees.append(whitened @ np.linalg.solve(reduced / np.outer(scale, scale), whitened))
    return Trials(np.array(errors), np.array(covariances), np.array(nees), span.shape[1])


@dataclass(frozen=True)
class Options:
    """Predicted against observed spread of a calibration.

    Example: python -m tools.camera_evaluation covariance images/e/e.cam --trials 100

    Parameters
    ----------
    camera : Path
        The true camera.
    boards : several str
        `checkerboard`, `charuco` (of which 70 % of the corners are seen), `asymmetric-circles` (by
        their centroids).
    views : int
        Boards in each calibration.
    trials : int
        Calibrations.
    sigma_px : float
        Noise of a coordinate.
    outliers : float
        Share of points that are 20 standard deviations off.
    seed : int
        Everything random follows from it.
    """

    camera: Positional[Path]
    boards: tuple[str, ...] = ("checkerboard", "charuco", "asymmetric-circles")
    views: int = 25
    trials: int = 100
    sigma_px: float = 0.03
    outliers: float = 0.0
    seed: int = 1


def main(arguments: list[str]) -> int:
    """Run the study."""
    options = tyro.cli(Options, prog="covariance", args=arguments)
    camera = read_camera(options.camera)
    for name in options.boards:
        board, distances_m = BOARDS[name]
        trials = monte_carlo(
            camera,
            board,
            views=options.views,
            trials=options.trials,
            sigma_px=options.sigma_px,
            seed=options.seed,
            distances_m=distances_m,
            outliers=options.outliers,
            seen=0.7 if board.kind == "charuco" else 1.0,
        )
        predicted = np.sqrt(np.diag(trials.covariances.mean(axis=0)))
        print(f"{name}: {options.trials} x {options.views} views, noise {options.sigma_px} px")
        print("            observed   predicted   ratio")
        for parameter, seen, said in zip(INTRINSICS, trials.errors.std(axis=0), predicted):
            if said > 0.0:
                print(f"{parameter:8s} {seen:11.5g} {said:11.5g} {seen / said:7.3f}")
        print(
            f"normalised squared error {trials.nees.mean():.2f} "
            f"(expected {trials.freedom}, +- {np.sqrt(2 * trials.freedom / len(trials.nees)):.2f})",
            flush=True,
        )
    return 0
