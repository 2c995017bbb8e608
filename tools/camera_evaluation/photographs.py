"""Hold-out error on real photographs of disc boards, against OpenCV's rational model.

The points are the centroids of the discs in the photographs, found from where the truth has them;
both calibrations get the same points and the same board, and leave out the same photographs: each
in turn, every third, and thirds of the series.

Example: python -m tools.camera_evaluation photographs ../shared/data/discs/dev
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from tyro.conf import Positional

from camera.boards.board import Board
from camera.boards.points import circle_centroids
from camera.calibration.adjustment import Points
from camera.calibration.calibrate import BoardView, calibrate
from camera.calibration.choice import holdout_error
from camera.calibration.images import read_grey
from camera.calibration.settings import CalibrationSettings, FreeLens
from camera.errors import CalibrationError

FloatArray = NDArray[np.float64]
DISC_RADIUS_M = 0.1


class FixedBoard(Board):
    """A board whose points are what was measured: places by their number, not a regular print."""

    @property
    def points(self) -> FloatArray:
        """(N, 3) all discs of all photographs, one after the other."""
        return np.asarray(self.__dict__["_places"])


def fixed_board(places: FloatArray) -> Board:
    """A board of discs at given places, (N, 3) in metres."""
    board = FixedBoard("circles", 3, 3, 1.0, circle_m=2.0 * DISC_RADIUS_M)
    board.__dict__["_places"] = places
    return board


def read_group(folder: Path, group: str) -> tuple[list[BoardView], Board, tuple[int, int]]:
    """All photographs of a camera, in the folder or below: views, the board, and the image size.

    Raises
    ------
    CalibrationError
        If there are none.
    """
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
    return views, fixed_board(np.concatenate(places)), size


def splits(views: int) -> dict[str, list[NDArray[np.int64]]]:
    """Ways to leave photographs out, by name: which ones together."""
    every = np.arange(views)
    return {
        "each": [every[v : v + 1] for v in every],
        "every third": [every[every % 3 == k] for k in range(3)],
        "thirds": [np.asarray(part) for part in np.array_split(every, 3)],
    }


def opencv_holdout(
    points: Points,
    folds: list[NDArray[np.int64]],
    *,
    rational: bool,
    tangential: bool = True,
) -> float:
    """RMS error (px) in the photographs left out, by OpenCV: their poses alone are fitted."""
    import cv2

    every = np.arange(len(points.starts))
    flags = cv2.CALIB_RATIONAL_MODEL if rational else 0
    flags |= 0 if tangential else cv2.CALIB_ZERO_TANGENT_DIST
    squares = 0.0
    size = (points.width, points.height)
    for out in folds:
        used = points.of(np.setdiff1d(every, out))
        board = [used.board[s : s + n].astype(np.float32) for s, n in zip(used.starts, used.counts)]
        seen = [used.pixels[s : s + n].astype(np.float32) for s, n in zip(used.starts, used.counts)]
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
class Options:
    """Hold-out error on photographs of discs, against OpenCV's models.

    Example: python -m tools.camera_evaluation photographs ../shared/data/discs/dev

    Parameters
    ----------
    folder : Path
        Folder of photographs with truth.
    groups : several str
        Cameras: beginnings of the photographs' names.
    free_aspect : bool
        Both scales free, as OpenCV has them; else equal.
    polynomial : bool
        Here the radial distortion is the polynomial k1 k2 k3; else that is chosen as by default.
    """

    folder: Positional[Path]
    groups: tuple[str, ...] = ("asym", "sym", "rct", "robvis")
    free_aspect: bool = True
    polynomial: bool = False


@dataclass(frozen=True)
class Comparison:
    """Errors (px) in what was held out of a camera's photographs, all on the same points.

    Attributes
    ----------
    views, points : int
        Photographs; points in all of them.
    lens : FreeLens
        Coefficients that are free here.
    ours, rational, radial, five : dict of str to float
        By split: this project; OpenCV's rational model (k1 to k6, p1, p2), the same without p1 and
        p2, and its k1 k2 p1 p2 k3.
    """

    views: int
    points: int
    lens: FreeLens
    ours: dict[str, float]
    rational: dict[str, float]
    radial: dict[str, float]
    five: dict[str, float]


def compare(folder: Path, group: str, *, free_aspect: bool, polynomial: bool = False) -> Comparison:
    """Hold out photographs of a camera, by each of `splits`."""
    views, board, size = read_group(folder, group)
    settings = CalibrationSettings(
        aspect=None if free_aspect else 1.0,
        polynomial=True if polynomial else None,
        robust=False,
        keep_outliers=True,
    )
    result = calibrate(views, board, size, settings)
    # The same corrected points for both: OpenCV knows nothing of circles.
    points, lens = result.points, result.lens
    estimate = result.adjusted.estimate
    ways = splits(len(points.starts))
    return Comparison(
        views=len(points.starts),
        points=len(points.board),
        lens=lens,
        ours={name: holdout_error(estimate, points, settings, lens, w) for name, w in ways.items()},
        rational={name: opencv_holdout(points, w, rational=True) for name, w in ways.items()},
        radial={
            name: opencv_holdout(points, w, rational=True, tangential=False)
            for name, w in ways.items()
        },
        five={name: opencv_holdout(points, w, rational=False) for name, w in ways.items()},
    )


def main(arguments: list[str]) -> int:
    """Run the study."""
    options = tyro.cli(Options, prog="photographs", args=arguments)
    print("RMS of what was held out, px; OpenCV: rational, the same without p1 p2, k1 k2 p1 p2 k3")
    print("group      views points  held out        ours rational   radial     five  free here")
    for group in options.groups:
        r = compare(
            options.folder, group, free_aspect=options.free_aspect, polynomial=options.polynomial
        )
        for name in r.ours:
            print(
                f"{group:10s} {r.views:4d} {r.points:6d}  {name:11s} "
                f"{r.ours[name]:8.4f} {r.rational[name]:8.4f} {r.radial[name]:8.4f} "
                f"{r.five[name]:8.4f}  {r.lens}",
                flush=True,
            )
    return 0
