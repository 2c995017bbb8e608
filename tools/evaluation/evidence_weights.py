"""Weights of the evidence of a second look (`detect.discs.second_kernels`), fitted anew.

Candidates come from rendered buildings with known truth, from discs of these and of real images
that were disturbed (`tools.evaluation.disturbances`), and from a recorded run with its map: there
only what is far from every mapped disc is used, as what is no disc.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from camera import Camera, read_camera
from camera.calibration.floor import with_pose
from detect.circles import candidates_of, detect_circles, disc_shape, second_looks_at
from detect.discs.second_kernels import FEATURES
from detect.noise import estimate_noise
from detect.settings import CircleSettings
from lut import DiscTable, cached_disc_table
from tools.evaluation.disturbances import DISTURBANCES, disturbed

FloatArray = NDArray[np.float64]

_SETTINGS = CircleSettings(polarity="light")
#: There is no second look with these.
_FIRST = CircleSettings(polarity="any")
#: Of the weights about 0: one over its variance.
_RIDGE = 3.0
#: A row of a real image that is no disc counts as much as so many others.
_REAL_WEIGHT, _DISTURBED_WEIGHT = 2.0, 0.3


@dataclass(frozen=True)
class Looks:
    """Second looks of known truth.

    Attributes
    ----------
    features : (N, F) float64
    is_disc : (N,) bool
    weight : (N,) float64
    source : (N,) str
    frame : (N,) int64
    place : (N, 2) float64
        Metres.
    """

    features: FloatArray
    is_disc: NDArray[np.bool_]
    weight: FloatArray
    source: NDArray[np.str_]
    frame: NDArray[np.int64]
    place: FloatArray


class _Gathering:
    def __init__(self) -> None:
        self.rows: list[tuple[FloatArray, bool, float, str, int, FloatArray]] = []

    def add(
        self,
        image: NDArray[np.uint8],
        view: tuple[Camera, DiscTable],
        discs: FloatArray,
        unsure: FloatArray,
        weight: tuple[float, float],
        source: str,
        frame: int,
    ) -> None:
        """Looks at an image with discs and unsure places in pixels: u, v, half width and height."""
        camera, table = view
        noise = estimate_noise(image, 32)
        centres = candidates_of(image, table, _SETTINGS, 0.0)
        found = detect_circles(image, camera, table, _FIRST)
        looks = second_looks_at(image, camera, table, _SETTINGS, centres, found.floor_xy, noise)
        pixels = camera.project_floor(looks.place)
        for features, place, uv in zip(looks.features, looks.place, pixels, strict=True):
            if not np.isfinite(features).all():
                continue
            near, far = _nearest(uv, discs), _nearest(uv, unsure)
            if near < 0.6 and weight[0] > 0.0:
                self.rows.append((features, True, weight[0], source, frame, place))
            elif near > 1.5 and far > 1.5 and weight[1] > 0.0:
                self.rows.append((features, False, weight[1], source, frame, place))

    def looks(self) -> Looks:
        features, is_disc, weight, source, frame, place = zip(*self.rows, strict=True)
        return Looks(
            np.array(features), np.array(is_disc), np.array(weight), np.array(source),
            np.array(frame), np.array(place),
        )  # fmt: skip


def _nearest(uv: FloatArray, places: FloatArray) -> float:
    if len(places) == 0:
        return np.inf
    off = np.hypot(*((uv - places[:, :2]) / places[:, 2:]).T)
    return float(np.nanmin(off, initial=np.inf))


def _images(camera: Camera, places: FloatArray, slack_px: float) -> FloatArray:
    """(N, 4) pixel, half width and half height of discs."""
    angle = np.linspace(0.0, 2.0 * np.pi, 24)
    rim = 0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rows = []
    for place in places.reshape(-1, 2):
        outline = camera.project_floor(place + rim)
        middle = camera.project_floor(place[None])[0]
        if np.isfinite(outline).all():
            half = np.maximum(np.ptp(outline, axis=0) / 2.0, [3.0, 1.5])
            rows.append([*middle, *(half + slack_px)])
    return np.array(rows).reshape(-1, 4)


def gather(data: Path, every: int, seed: int) -> Looks:
    """Look at all sources of a folder of data (see `docs/measured.md`); every n-th real frame."""
    rng = np.random.default_rng(seed)
    gathering = _Gathering()
    for folder in sorted((data / "rendered").glob("r*")):
        camera = read_camera(folder / f"{folder.name}.cam")
        view = camera, cached_disc_table(camera, disc_shape(_SETTINGS))
        for frame in json.loads((folder / "truth.json").read_text())["frames"]:
            image = _read(folder / "images" / f"{frame['prefix']}.jpg")
            sizes = {
                c["id"]: _images(camera, np.array([[c["px"], c["py"]]]), 0.0)
                for c in frame["circles"]
            }
            at = [
                (c["mandatory"], [c["u"], c["v"], *sizes[c["id"]][0, 2:]])
                for c in frame["circles"]
                if len(sizes[c["id"]])
            ]
            sure = np.array([a for mandatory, a in at if mandatory]).reshape(-1, 4)
            unsure = np.array([a for mandatory, a in at if not mandatory]).reshape(-1, 4)
            gathering.add(image, view, sure, unsure, (1.0, 1.0), folder.name, frame["index"])
            _add_disturbed(gathering, image, view, rng, f"{folder.name} disturbed", frame["index"])
    run = data / "dlr"
    camera = read_camera(run / "e" / "e.cam")
    view = camera, cached_disc_table(camera, disc_shape(_SETTINGS))
    for number, (name, mapped) in enumerate(_mapped(run)):
        path = run / "e" / "images" / f"{name}.jpg"
        if number % every or not path.is_file():
            continue
        image = _read(path)
        places = np.zeros((0, 4))
        gathering.add(image, view, places, mapped, (0.0, _REAL_WEIGHT), "real", number)
        if number % (3 * every) == 0:
            _add_disturbed(gathering, image, view, rng, "real disturbed", number)
    return gathering.looks()


def _add_disturbed(
    gathering: _Gathering,
    image: NDArray[np.uint8],
    view: tuple[Camera, DiscTable],
    rng: np.random.Generator,
    source: str,
    frame: int,
) -> None:
    found = detect_circles(image, *view, _FIRST)
    clear = np.flatnonzero(found.evidence > 4.0)
    for i in rng.permutation(clear)[:3]:
        kind = str(rng.choice(list(DISTURBANCES)))
        changed = disturbed(image, view[1].floor_xy, found.floor_xy[i], 0.1, kind, rng)
        if changed is not None:
            disc = _images(view[0], found.floor_xy[i], 0.0)
            gathering.add(
                changed, view, disc, np.zeros((0, 4)), (_DISTURBED_WEIGHT, 0.0), source, frame
            )


def _mapped(run: Path) -> Iterator[tuple[str, FloatArray]]:
    """Names of frames, and where mapped discs are in them, with some slack."""
    camera = read_camera(run / "e" / "e.cam")
    true = np.array(json.loads((run / "mounting.json").read_text())["robot_from_camera"])
    rows = list(csv.DictReader((run / "levelled_map.csv").open()))
    discs = np.array([(float(d["x_m"]), float(d["y_m"])) for d in rows])
    seen = with_pose(camera, true)
    for pose in csv.DictReader((run / "levelled_path.csv").open()):
        if not pose["prefix"][-4:].isdigit():
            continue
        x, y, turn = (float(pose[k]) for k in ("x_m", "y_m", "theta_rad"))
        cos, sin = np.cos(turn), np.sin(turn)
        places = (discs - [x, y]) @ [[cos, -sin], [sin, cos]]
        near = places[np.hypot(*places.T) < 9.5]
        yield pose["prefix"], _images(seen, near, 4.0)


def _read(path: Path) -> NDArray[np.uint8]:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)


def fit_weights(looks: Looks, used: NDArray[np.bool_]) -> FloatArray:
    """(1 + F,) constant and weights of the logistic regression on some looks."""
    terms = np.c_[np.ones(used.sum()), looks.features[used]]
    target, weight = looks.is_disc[used].astype(np.float64), looks.weight[used]

    def cost(b: FloatArray) -> tuple[float, FloatArray]:
        odds = terms @ b
        ridge = np.append(0.0, b[1:])
        value = float(weight @ (np.logaddexp(0.0, odds) - target * odds))
        slope = terms.T @ (weight * (1.0 / (1.0 + np.exp(-odds)) - target))
        return value + 0.5 * _RIDGE * float(ridge @ ridge), slope + _RIDGE * ridge

    start = np.zeros(terms.shape[1])
    return np.asarray(minimize(cost, start, jac=True, method="L-BFGS-B").x)


def report(looks: Looks) -> str:
    """Weights, and what they do to each source when it was left out of fitting them."""
    every = np.ones(len(looks.is_disc), np.bool_)
    lines = [
        f"{len(every)} looks, {looks.is_disc.sum()} at discs",
        "name weight",
    ]
    weights = fit_weights(looks, every)
    lines += [f"{n} {w:.2f}" for n, w in zip(("constant", *FEATURES), weights, strict=True)]
    buildings = np.array([s.split()[0] for s in looks.source])
    for left_out in np.unique(buildings):
        own = buildings == left_out
        halves = [own & (looks.frame % 20 < 10), own & (looks.frame % 20 >= 10)]
        parts = halves if left_out == "real" else [own]
        odds = np.full(len(own), np.nan)
        for part in parts:
            b = fit_weights(looks, ~part)
            odds[part] = b[0] + looks.features[part] @ b[1:]
        for source in np.unique(looks.source[own]):
            of = looks.source == source
            discs, others = odds[of & looks.is_disc], odds[of & ~looks.is_disc]
            text = ", ".join(
                f">= {t:g}: {(discs >= t).sum()}/{len(discs)} discs, {(others >= t).sum()} others"
                for t in (-1.5, -1.0, -0.5, 0.0, 0.5, 1.0)
            )
            lines.append(f"left out {source}: {text}")
    return "\n".join(lines)
