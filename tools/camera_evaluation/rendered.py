"""Calibrating from rendered pictures of a board: noise floor, and how near the truth.

Example: python -m tools.camera_evaluation rendered images/e/e.cam --half
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tyro.conf import Positional

from camera import Camera, read_camera
from camera.boards.board import Board
from camera.boards.points import find_board
from camera.calibration.adjustment import Estimate
from camera.calibration.calibrate import (
    BoardView,
    Calibration,
    calibrate,
    points_of,
)
from camera.calibration.fit import circle_shifts
from camera.calibration.projection import (
    intrinsics_of,
    projection_difference,
    projection_sigma,
    with_intrinsics,
)
from camera.calibration.settings import CalibrationSettings
from camera.errors import CalibrationError
from tools.camera_evaluation.rendering import board_poses, rays_of, render_board

BOARDS = {
    "checkerboard": (Board("checkerboard", 9, 6, 0.04), (0.2, 0.45)),
    "charuco": (Board("charuco", 10, 7, 0.04, marker_m=0.028), (0.25, 0.45)),
    "asymmetric-circles": (Board("asymmetric-circles", 4, 11, 0.03, circle_m=0.03), (0.25, 0.5)),
}


@dataclass(frozen=True)
class Rendered:
    """A calibration from rendered pictures, against the truth.

    Attributes
    ----------
    calibration : Calibration
    camera : Camera
        With the estimated intrinsics.
    floor_px : float
        RMS distance (u and v together) of the points found from the true ones.
    found : int
        Pictures in which the board was found.
    """

    calibration: Calibration
    camera: Camera
    floor_px: float
    found: int


def calibrate_rendered(
    camera: Camera,
    board: Board,
    distances_m: tuple[float, float],
    *,
    views: int,
    seed: int,
    blur_px: float = 0.6,
    noise: float = 2.0,
) -> Rendered:
    """Render pictures of a board, find its points, calibrate.

    Raises
    ------
    CalibrationError
        As `calibrate`.
    """
    rays = rays_of(camera)
    seen, poses = [], []
    for i, (R, t) in enumerate(board_poses(camera, board, views, seed, distances_m=distances_m)):
        image = render_board(rays, board, R, t, blur_px=blur_px, noise=noise, seed=seed + i)
        try:
            indices, pixels = find_board(image, board)
        except CalibrationError:
            continue
        seen.append(BoardView(f"{i:03d}", indices, pixels))
        poses.append((R, t))
    size = (camera.width, camera.height)
    settings = CalibrationSettings(aspect=camera.scale_y / camera.scale_x)
    calibration = calibrate(seen, board, size, settings)
    points = points_of(seen, board, size)
    truth = Estimate(
        intrinsics_of(camera), np.stack([R for R, _ in poses]), np.stack([t for _, t in poses])
    )
    expected = np.concatenate(
        [camera.project(board.points[v.indices] @ R.T + t) for v, (R, t) in zip(seen, poses)]
    )
    if board.circle_m > 0.0:
        expected = expected + circle_shifts(truth, points, 0.5 * board.circle_m)
    # Without those that the calibration leaves out as wrong, too.
    error = points.pixels - expected
    right = np.all(np.abs(error) < 8.0 * calibration.adjusted.sigma_px, axis=1)
    found = with_intrinsics(camera, calibration.intrinsics)
    floor = float(np.sqrt(np.mean(np.sum(error[right] ** 2, axis=1))))
    return Rendered(calibration, found, floor, len(seen))


@dataclass(frozen=True)
class Options:
    """Calibrate from rendered pictures of a known camera.

    Example: python -m tools.camera_evaluation rendered images/e/e.cam

    Parameters
    ----------
    camera : Path
        The true camera.
    boards : several str
        `checkerboard`, `charuco`, `asymmetric-circles`.
    views : int
        Pictures.
    blur_px : float
        Standard deviation of a Gaussian blur.
    noise : float
        Standard deviation of a pixel's noise (grey values; ink and paper differ by 160).
    seed : int
        Everything random follows from it.
    """

    camera: Positional[Path]
    boards: tuple[str, ...] = ("checkerboard", "charuco", "asymmetric-circles")
    views: int = 24
    blur_px: float = 0.6
    noise: float = 2.0
    seed: int = 7


def main(arguments: list[str]) -> int:
    """Run the study."""
    options = tyro.cli(Options, prog="rendered", args=arguments)
    camera = read_camera(options.camera)
    for name in options.boards:
        board, distances = BOARDS[name]
        made = calibrate_rendered(
            camera,
            board,
            distances,
            views=options.views,
            seed=options.seed,
            blur_px=options.blur_px,
            noise=options.noise,
        )
        result = made.calibration
        fixed = projection_difference(camera, made.camera, rotate=False).max()
        turned = projection_difference(camera, made.camera)
        sigma = projection_sigma(made.camera, result.adjusted.covariance)
        print(
            f"{name}: found in {made.found} of {options.views}; free "
            f"{result.lens}; RMS {result.adjusted.rms_px:.4f} px, points' own error "
            f"{made.floor_px:.4f} px, held out {result.holdout_px[result.lens]:.4f} px; "
            f"projection off by at most {turned.max():.4f} px ({fixed:.4f} px with the camera's "
            f"rotation fixed), median {np.median(turned):.4f} px; predicted {sigma.max():.4f} and "
            f"{np.median(sigma):.4f} px"
        )
    return 0
