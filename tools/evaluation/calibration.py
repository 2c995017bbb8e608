"""Accuracy of camera calibrations: from rendered boards and from photographs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from tyro.conf import Positional

from camera import Camera, read_camera
from camera.boards.board import Board
from camera.boards.points import circle_centroids, find_board
from camera.calibration.adjustment import Estimate, Points, circle_shifts
from camera.calibration.calibrate import BoardView, Calibration, calibrate, points_of
from camera.calibration.choice import cross_validation_error
from camera.calibration.model import CalibrationSettings, FreeLens
from camera.errors import CalibrationError
from camera.uncertainty import intrinsics_of, projection_sigma, with_intrinsics
from redetect.array_types import FloatArray, IntArray
from redetect.storage.images import read_grey
from tools.evaluation.boards import board_poses, projection_difference, rays_of, render_board
from tools.evaluation.figures import Figures, Study
from tools.evaluation.tables import Table

BOARDS = {
    "checkerboard": (Board("checkerboard", 9, 6, 0.04), (0.2, 0.45)),
    "charuco": (Board("charuco", 10, 7, 0.04, marker_m=0.028), (0.25, 0.45)),
    "asymmetric-circles": (Board("asymmetric-circles", 4, 11, 0.03, circle_m=0.03), (0.25, 0.5)),
}


@dataclass(frozen=True)
class Rendered:
    """A calibration from rendered pictures, against the truth."""

    calibration: Calibration
    camera: Camera  # With the estimated intrinsics.
    floor_px: float  # RMS distance (u and v together) of the points found from the true ones.
    found: int  # Pictures in which the board was found.


def calibrate_rendered(
    camera: Camera,
    board: Board,
    distances_m: tuple[float, float],
    *,
    views: int,
    seed: int,
) -> Rendered:
    """Render pictures of a board, find its points, calibrate."""
    rays = rays_of(camera)
    seen, poses = [], []
    for i, (R, t) in enumerate(board_poses(camera, board, views, seed, distances_m=distances_m)):
        image = render_board(rays, board, R, t, seed=seed + i)
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
    truth = Estimate(intrinsics_of(camera), *map(np.stack, zip(*poses)))
    expected = np.concatenate(
        [camera.project(board.points[v.indices] @ R.T + t) for v, (R, t) in zip(seen, poses)]
    )
    if board.circle_m > 0.0:
        expected = expected + circle_shifts(truth, points, 0.5 * board.circle_m)
    # Without the points that the calibration leaves out as wrong.
    error = points.pixels - expected
    right = np.all(np.abs(error) < 8.0 * calibration.adjusted.sigma_px, axis=1)
    found = with_intrinsics(camera, calibration.intrinsics)
    floor = float(np.sqrt(np.mean(np.sum(error[right] ** 2, axis=1))))
    return Rendered(calibration, found, floor, len(seen))


DISC_RADIUS_M = 0.1


class FixedBoard(Board):
    """Discs at measured places: those of all photographs, one after the other."""

    def __init__(self, places: FloatArray) -> None:
        super().__init__("circles", 3, 3, 1.0, circle_m=2.0 * DISC_RADIUS_M)
        object.__setattr__(self, "places", places)

    @property
    def points(self) -> FloatArray:
        """(N, 3) in metres."""
        return np.asarray(vars(self)["places"])


def read_group(
    folder: Path, group: str, every: int
) -> tuple[list[BoardView], Board, tuple[int, int]]:
    """Photographs of a camera below a folder, one of `every` discs each: views, board, size."""
    views: list[BoardView] = []
    places: list[FloatArray] = []
    offset, size = 0, (0, 0)
    for path in sorted(folder.glob(f"**/{group}_*/truth.json")):
        truth = json.loads(path.read_text())
        discs = [d for d in truth["discs"] if d["how"] == "measured" and d["visible"]][::every]
        uv = np.array([[d["u"], d["v"]] for d in discs])
        xy = np.array([[d["px"], d["py"], 0.0] for d in discs])
        image = read_grey(next((path.parent / "images").iterdir()), CalibrationError)
        size = (image.shape[1], image.shape[0])
        dark = image if truth["polarity"] == "dark" else 255 - image
        # The truth only says where to search; the points are measured in the image.
        seen = circle_centroids(dark, uv[None])[0]
        near = np.any(seen != uv, axis=1) & (np.linalg.norm(seen - uv, axis=1) < 3.0)
        uv, xy = seen[near], xy[near]
        views.append(BoardView(path.parent.name, np.arange(offset, offset + len(uv)), uv))
        places.append(xy)
        offset += len(uv)
    if not views:
        raise CalibrationError(f"{folder}: no photographs there, expected {group}_*/truth.json")
    return views, FixedBoard(np.concatenate(places)), size


def splits(views: int) -> dict[str, list[IntArray]]:
    """Ways to hold out photographs, by name: groups that are held out together."""
    every = np.arange(views)
    return {
        "each": [every[v : v + 1] for v in every],
        "every third": [every[every % 3 == k] for k in range(3)],
        "thirds": [np.asarray(part) for part in np.array_split(every, 3)],
    }


def opencv_holdout(points: Points, folds: list[IntArray], *, tangential: bool) -> float:
    """RMS error (px) of OpenCV's model in held-out photographs, of which only poses are fitted."""
    every = np.arange(len(points.counts))
    flags = cv2.CALIB_RATIONAL_MODEL | (0 if tangential else cv2.CALIB_ZERO_TANGENT_DIST)
    squares = 0.0
    size = (points.width, points.height)
    for out in folds:
        used = points.of_views(np.setdiff1d(every, out))
        rows = [used.views == view for view in range(len(used.counts))]
        board = [used.board[chosen].astype(np.float32) for chosen in rows]
        seen = [used.pixels[chosen].astype(np.float32) for chosen in rows]
        _, K, d, _, _ = cv2.calibrateCamera(board, seen, size, np.eye(3), np.zeros(8), flags=flags)
        for view in out:
            held = points.of_views(np.array([view]))
            _, rvec, tvec = cv2.solvePnP(held.board, held.pixels, K, d)
            rvec, tvec = cv2.solvePnPRefineLM(held.board, held.pixels, K, d, rvec, tvec)
            found = cv2.projectPoints(held.board, rvec, tvec, K, d)[0].reshape(-1, 2)
            squares += float(np.sum((found - held.pixels) ** 2))
    return float(np.sqrt(squares / len(points.board)))


@dataclass(frozen=True)
class Comparison:
    """Errors (px) in held-out photographs of a camera, all on the same points."""

    views: int  # Photographs; points in all of them.
    points: int
    lens: FreeLens  # Coefficients that are free here.
    errors: dict[str, dict[str, float]]
    """By split: of this project (`ours`); of OpenCV's rational model (k1 to k6, p1, p2), and the
    same without p1 and p2 (`radial`)."""


#: OpenCV's models, by their names in `Comparison.errors`: with p1 and p2, or without.
OPENCV = {"rational": True, "radial": False}


def compare(
    folder: Path,
    group: str,
    *,
    peers: Sequence[str] = tuple(OPENCV),
    every: int = 1,
    polynomial: bool | None = None,
) -> Comparison:
    """Hold out photographs of a camera, by each of `splits`, of this project's model and peers."""
    views, board, size = read_group(folder, group, every)
    # Both scales are free, as in OpenCV.
    settings = CalibrationSettings(
        aspect=None, robust=False, keep_outliers=True, polynomial=polynomial
    )
    result = calibrate(views, board, size, settings)
    # The same corrected points for both: OpenCV has no correction for circles.
    points, lens = result.points, result.lens
    estimate = result.adjusted.estimate
    errors = {
        name: {
            "ours": cross_validation_error(estimate, points, settings, lens, folds),
            **{peer: opencv_holdout(points, folds, tangential=OPENCV[peer]) for peer in peers},
        }
        for name, folds in splits(len(points.counts)).items()
    }
    return Comparison(len(points.counts), len(points.board), lens, errors)


@dataclass(frozen=True)
class CameraRendered(Study):
    """Calibrate from rendered pictures of a known camera: residuals, and errors of the result."""

    camera: Positional[Path]  # The true camera.
    boards: tuple[str, ...] = tuple(BOARDS)  # `checkerboard`, `charuco`, `asymmetric-circles`.
    views: int = 24  # Number of pictures.
    seed: int = 7  # Of everything random.

    def measure(self) -> Figures:
        camera = read_camera(self.camera)
        print("Points' own error, held out, projection (worst, median, predicted) in px")
        table = Table(
            {"board": "<19", "found": "d", "free": "<24", "RMS": ".4f", "points": ".4f",
             "held out": ".4f", "worst": ".4f", "unrotated": ".4f",
             "median error": ".4f", "predicted": ".4f", "median predicted": ".4f"}
        )  # fmt: skip
        for name in self.boards:
            board, distances = BOARDS[name]
            made = calibrate_rendered(camera, board, distances, views=self.views, seed=self.seed)
            result = made.calibration
            fixed = projection_difference(camera, made.camera, rotate=False).max()
            turned = projection_difference(camera, made.camera)
            sigma = projection_sigma(made.camera, result.adjusted.covariance)
            table.row(
                name, made.found, str(result.lens), result.adjusted.rms_px, made.floor_px,
                result.cross_validation_px[result.lens], turned.max(), fixed, np.median(turned),
                sigma.max(), np.median(sigma),
            )  # fmt: skip
        return table.figures


@dataclass(frozen=True)
class CameraPhotographs(Study):
    """Hold-out error on photographs of disc boards, compared with OpenCV's models.

    The points are the centroids of the discs, searched near their true positions; both
    calibrations use the same points and board, and hold out the same photographs.
    """

    folder: Positional[Path]  # Folder of photographs with truth.
    groups: tuple[str, ...] = ("asym", "sym", "rct", "robvis")  # Cameras, by prefix of the names.
    polynomial: Literal["auto", "on", "off"] = "auto"  # As of `camera calibrate`.

    def measure(self) -> Figures:
        print("RMS px; OpenCV: rational, the same without p1 p2 (radial)")
        errors = dict.fromkeys(("ours", "rational", "radial"), "8.4f")
        table = Table(
            {"group": "<9", "views": "d", "points": "d", "held out": "<11", **errors,
             "free here": "<"}
        )  # fmt: skip
        polynomial = {"auto": None, "on": True, "off": False}[self.polynomial]
        for group in self.groups:
            r = compare(self.folder, group, polynomial=polynomial)
            for name, found in r.errors.items():
                table.row(group, r.views, r.points, name, *found.values(), str(r.lens))
        return table.figures
