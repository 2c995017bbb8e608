"""What calibrating and converting cameras is worth: rendered boards, photographs, conversions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from camera import Camera, read_camera
from camera.boards.board import Board
from camera.boards.points import circle_centroids, find_board
from camera.calibration.adjustment import Estimate, Points, circle_shifts, fit_points
from camera.calibration.calibrate import BoardView, Calibration, calibrate, points_of
from camera.calibration.choice import holdout_error
from camera.calibration.images import read_grey
from camera.calibration.model import INTRINSICS, CalibrationSettings, FreeLens
from camera.errors import CalibrationError
from camera.formats.command import MODELS
from camera.formats.conversion import Rows, convert_to_camera, convert_to_foreign
from camera.formats.models import ForeignCamera, Model
from camera.uncertainty import (
    intrinsics_of,
    pixel_grid,
    projection_sigma,
    with_intrinsics,
)
from tools.arrays import FloatArray, IntArray
from tools.evaluation.boards import board_poses, projection_difference, rays_of, render_board
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
    blur_px: float = 0.6,
    noise: float = 2.0,
) -> Rendered:
    """Render pictures of a board, find its points, calibrate."""
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
    truth = Estimate(intrinsics_of(camera), *map(np.stack, zip(*poses)))
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
class Trials:
    """Results of repeated calibrations."""

    errors: FloatArray  # (T, 14) Estimated less true intrinsics.
    covariances: FloatArray  # (T, 14, 14) As predicted.
    nees: FloatArray
    """(T,) Normalised squared errors of the projection, over its free directions; `freedom` on
    average."""
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
    """Calibrate again and again from the same poses with new noise."""
    poses = board_poses(camera, board, views, seed, distances_m=distances_m)
    truth = Estimate(intrinsics_of(camera), *map(np.stack, zip(*poses)))
    rng = np.random.default_rng(seed + 1)
    count = max(round(seen * len(board.points)), 6)
    chosen = np.stack([np.sort(rng.choice(len(board.points), count, replace=False)) for _ in poses])
    exact = Points(
        board.points[chosen].reshape(-1, 3),
        np.concatenate(
            [camera.project(board.points[k] @ R.T + t) for k, (R, t) in zip(chosen, poses)]
        ),
        np.repeat(np.arange(views), count),
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


DISC_RADIUS_M = 0.1


class FixedBoard(Board):
    """Discs at places that were measured: all of all photographs, one after the other."""

    def __init__(self, places: FloatArray) -> None:
        super().__init__("circles", 3, 3, 1.0, circle_m=2.0 * DISC_RADIUS_M)
        object.__setattr__(self, "places", places)

    @property
    def points(self) -> FloatArray:
        """(N, 3) in metres."""
        return np.asarray(vars(self)["places"])


def read_group(folder: Path, group: str) -> tuple[list[BoardView], Board, tuple[int, int]]:
    """All photographs of a camera, in the folder or below: views, the board, and the image size."""
    views: list[BoardView] = []
    places: list[FloatArray] = []
    offset, size = 0, (0, 0)
    for path in sorted(folder.glob(f"**/{group}_*/truth.json")):
        truth = json.loads(path.read_text())
        discs = [d for d in truth["discs"] if d["how"] == "measured" and d["visible"]]
        uv = np.array([[d["u"], d["v"]] for d in discs])
        xy = np.array([[d["px"], d["py"], 0.0] for d in discs])
        image = read_grey(next((path.parent / "images").iterdir()))
        size = (image.shape[1], image.shape[0])
        dark = image if truth["polarity"] == "dark" else 255 - image
        # The truth says where to look; what is measured is the image's.
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
    """Ways to leave photographs out, by name: which ones together."""
    every = np.arange(views)
    return {
        "each": [every[v : v + 1] for v in every],
        "every third": [every[every % 3 == k] for k in range(3)],
        "thirds": [np.asarray(part) for part in np.array_split(every, 3)],
    }


def opencv_holdout(
    points: Points, folds: list[IntArray], *, rational: bool, tangential: bool = True
) -> float:
    """RMS error (px) in the photographs left out, by OpenCV: their poses alone are fitted."""
    import cv2

    every = np.arange(len(points.counts))
    flags = cv2.CALIB_RATIONAL_MODEL if rational else 0
    flags |= 0 if tangential else cv2.CALIB_ZERO_TANGENT_DIST
    squares = 0.0
    size = (points.width, points.height)
    for out in folds:
        used = points.of(np.setdiff1d(every, out))
        rows = [used.views == view for view in range(len(used.counts))]
        board = [used.board[chosen].astype(np.float32) for chosen in rows]
        seen = [used.pixels[chosen].astype(np.float32) for chosen in rows]
        _, K, d, _, _ = cv2.calibrateCamera(
            board, seen, size, np.eye(3), np.zeros(8 if rational else 5), flags=flags
        )
        for view in out:
            held = points.of(np.array([view]))
            _, rvec, tvec = cv2.solvePnP(held.board, held.pixels, K, d)
            rvec, tvec = cv2.solvePnPRefineLM(held.board, held.pixels, K, d, rvec, tvec)
            found = cv2.projectPoints(held.board, rvec, tvec, K, d)[0].reshape(-1, 2)
            squares += float(np.sum((found - held.pixels) ** 2))
    return float(np.sqrt(squares / len(points.board)))


@dataclass(frozen=True)
class Comparison:
    """Errors (px) in what was held out of a camera's photographs, all on the same points."""

    views: int  # Photographs; points in all of them.
    points: int
    lens: FreeLens  # Coefficients that are free here.
    errors: dict[str, dict[str, float]]
    """By split: of this project (`ours`); of OpenCV's rational model (k1 to k6, p1, p2), the same
    without p1 and p2 (`radial`), and its k1 k2 p1 p2 k3 (`five`)."""


#: OpenCV's models, by their names in `Comparison.errors`.
OPENCV: dict[str, dict[str, bool]] = {
    "rational": {"rational": True},
    "radial": {"rational": True, "tangential": False},
    "five": {"rational": False},
}


def compare(
    folder: Path,
    group: str,
    *,
    free_aspect: bool,
    polynomial: bool = False,
    peers: Sequence[str] = tuple(OPENCV),
) -> Comparison:
    """Hold out photographs of a camera, by each of `splits`, of this project's model and peers."""
    views, board, size = read_group(folder, group)
    settings = CalibrationSettings(
        aspect=None if free_aspect else 1.0, polynomial=True if polynomial else None, robust=False,
        keep_outliers=True,
    )  # fmt: skip
    result = calibrate(views, board, size, settings)
    # The same corrected points for both: OpenCV knows nothing of circles.
    points, lens = result.points, result.lens
    estimate = result.adjusted.estimate
    errors = {
        name: {
            "ours": holdout_error(estimate, points, settings, lens, folds),
            **{peer: opencv_holdout(points, folds, **OPENCV[peer]) for peer in peers},
        }
        for name, folds in splits(len(points.counts)).items()
    }
    return Comparison(len(points.counts), len(points.board), lens, errors)


def _square(*distortion: float) -> ForeignCamera:
    k1, k2, p1, p2, k3 = distortion
    return ForeignCamera("radtan", 640, 480, 500.0, 500.0, 319.5, 239.5, (k1, k2, p1, p2, k3))


#: OpenCV's plumb bob: k1 k2 p1 p2 k3; the last three as published with EuRoC's cam0, KITTI's raw
#: data (camera 0) and TUM's fr1.
PLUMB_BOBS: dict[str, ForeignCamera] = {
    "tangential alone": _square(0.0, 0.0, 5e-3, 5e-3, 0.0),
    "mild, radial": _square(-0.2, 0.05, 0.0, 0.0, 0.0),
    "mild": _square(-0.2, 0.05, 2e-3, -3e-3, 0.0),
    "mild, large p": _square(-0.2, 0.05, 5e-3, 5e-3, 0.0),
    "strong, radial": _square(-0.3, 0.1, 0.0, 0.0, 0.0),
    "strong, large p": _square(-0.3, 0.1, 5e-3, 5e-3, 0.0),
    "wavy, radial": _square(0.1, -0.2, 0.0, 0.0, 0.05),
    "wavy, large p": _square(0.1, -0.2, 5e-3, 5e-3, 0.05),
    "KITTI": ForeignCamera(
        "radtan", 1392, 512, 984.2439, 980.8141, 690.0, 233.1966,
        (-0.3728755, 0.2037299, 0.002219027, 0.001383707, -0.07233722),
    ),
    "EuRoC": ForeignCamera(
        "radtan", 752, 480, 458.654, 457.296, 367.215, 248.375,
        (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0),
    ),
    "TUM fr1": ForeignCamera(
        "radtan", 640, 480, 517.306408, 516.469215, 318.64304, 255.313989,
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
}  # fmt: skip


_TYPES = ("checkerboard", "charuco", "asymmetric-circles")


@dataclass(frozen=True)
class CameraRendered:
    """Calibrate from rendered pictures of a known camera: noise floor, and how near the truth."""

    camera: Positional[Path]  # The true camera.
    boards: tuple[str, ...] = _TYPES  # `checkerboard`, `charuco`, `asymmetric-circles`.
    views: int = 24  # Pictures.
    blur_px: float = 0.6  # Standard deviation of a Gaussian blur.
    noise: float = 2.0  # Standard deviation of a pixel's noise; ink and paper differ by 160.
    seed: int = 7  # Everything random follows from it.

    def __call__(self) -> int:
        camera = read_camera(self.camera)
        print("Points' own error, held out, projection (worst, median, predicted) in px")
        table = Table(
            {"board": "<19", "found": "d", "free": "<24", "RMS": ".4f", "points": ".4f",
             "held out": ".4f", "worst": ".4f", "unrotated": ".4f", "median": ".4f",
             "predicted": ".4f", "median ": ".4f"}
        )  # fmt: skip
        for name in self.boards:
            board, distances = BOARDS[name]
            made = calibrate_rendered(
                camera, board, distances, views=self.views, seed=self.seed,
                blur_px=self.blur_px, noise=self.noise,
            )  # fmt: skip
            result = made.calibration
            fixed = projection_difference(camera, made.camera, rotate=False).max()
            turned = projection_difference(camera, made.camera)
            sigma = projection_sigma(made.camera, result.adjusted.covariance)
            table.row(
                name, made.found, str(result.lens), result.adjusted.rms_px, made.floor_px,
                result.holdout_px[result.lens], turned.max(), fixed, np.median(turned),
                sigma.max(), np.median(sigma),
            )  # fmt: skip
        return 0


@dataclass(frozen=True)
class CameraCovariance:
    """Predicted against observed spread of a calibration, by Monte Carlo."""

    camera: Positional[Path]  # The true camera.
    boards: tuple[str, ...] = _TYPES  # 70 % of the corners of `charuco` are seen.
    views: int = 25  # Boards in each calibration.
    trials: int = 100  # Calibrations.
    sigma_px: float = 0.03  # Noise of a coordinate.
    outliers: float = 0.0  # Share of points that are 20 standard deviations off.
    seed: int = 1  # Everything random follows from it.

    def __call__(self) -> int:
        camera = read_camera(self.camera)
        for name in self.boards:
            board, distances_m = BOARDS[name]
            trials = monte_carlo(
                camera, board, views=self.views, trials=self.trials, sigma_px=self.sigma_px,
                seed=self.seed, distances_m=distances_m, outliers=self.outliers,
                seen=0.7 if board.kind == "charuco" else 1.0,
            )  # fmt: skip
            predicted = np.sqrt(np.diag(trials.covariances.mean(axis=0)))
            print(f"{name}: {self.trials} x {self.views} views, noise {self.sigma_px} px")
            table = Table({"": "<9", "observed": "11.5g", "predicted": "11.5g", "ratio": "7.3f"})
            for parameter, seen, said in zip(INTRINSICS, trials.errors.std(axis=0), predicted):
                if said > 0.0:
                    table.row(parameter, seen, said, seen / said)
            band = np.sqrt(2 * trials.freedom / len(trials.nees))
            print(
                f"normalised squared error {trials.nees.mean():.2f} "
                f"(expected {trials.freedom}, +- {band:.2f})",
                flush=True,
            )
        return 0


@dataclass(frozen=True)
class CameraPhotographs:
    """Hold-out error on photographs of disc boards, against OpenCV's models.

    The points are the centroids of the discs, found from where the truth has them; both
    calibrations get the same points and board, and leave out the same photographs.
    """

    folder: Positional[Path]  # Folder of photographs with truth.
    groups: tuple[str, ...] = ("asym", "sym", "rct", "robvis")  # Cameras: the names' beginnings.
    free_aspect: bool = True  # Both scales free, as OpenCV has them; else equal.
    polynomial: bool = False  # Radial distortion k1 k2 k3 here; else chosen as by default.

    def __call__(self) -> int:
        print("RMS px; OpenCV: rational, the same without p1 p2 (radial), k1 k2 p1 p2 k3 (five)")
        errors = dict.fromkeys(("ours", "rational", "radial", "five"), "8.4f")
        table = Table(
            {"group": "<9", "views": "d", "points": "d", "held out": "<11", **errors,
             "free here": "<"}
        )  # fmt: skip
        for group in self.groups:
            r = compare(
                self.folder, group, free_aspect=self.free_aspect, polynomial=self.polynomial
            )
            for name, found in r.errors.items():
                table.row(group, r.views, r.points, name, *found.values(), str(r.lens))
        return 0


@dataclass(frozen=True)
class CameraConversions:
    """Convert a camera to each model and back; then cameras with OpenCV's plumb bob."""

    camera: Positional[Path]  # The camera.

    def __call__(self) -> int:
        camera = read_camera(self.camera)
        table = Table(
            {"model": "<10", "rows": "<7", "there (px)": ".5f", "back (px)": ".5f",
             "there and back against the camera (px)": ".5f"}
        )  # fmt: skip
        ways: list[tuple[Rows, Rows]] = [("same", "same"), ("double", "halve")]
        for model in MODELS["opencv"]:
            for out, home in ways:
                there = convert_to_foreign(camera, model, out)
                back = convert_to_camera(there.camera, home)
                assert isinstance(back.camera, Camera)
                whole = np.nanmax(projection_difference(camera, back.camera, rotate=False))
                table.row(model, out, there.deviation_px, back.deviation_px, whole)
        models: tuple[Model, ...] = ("radtan", "rational")
        table = Table(
            {"plumb bob": "<16", "p1 p2 move (px)": ".2f", "to .cam": ".2g",
             **{f"on to {model}": ".2g" for model in models}}
        )  # fmt: skip
        for name, bob in PLUMB_BOBS.items():
            k1, k2, _, _, k3 = bob.distortion
            without = replace(bob, distortion=(k1, k2, 0.0, 0.0, k3))
            rays = bob.undistort(pixel_grid(bob.width, bob.height))
            moved = np.linalg.norm(bob.distort(rays) - without.distort(rays), axis=1).max()
            known = convert_to_camera(bob)
            on = [convert_to_foreign(known.camera, model).deviation_px for model in models]
            table.row(name, moved, known.deviation_px, *on)
        return 0
