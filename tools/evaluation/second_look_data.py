"""Second looks of known truth (`detect.discs.second_look`), for training its network.

Candidates come from rendered buildings with known truth, from discs of these and of real images
that were disturbed (`tools.evaluation.disturbances`), and from a recorded run with its map: there
only what is far from every mapped disc is used, as what is no disc.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from camera import Camera, read_camera
from camera.kernels import camera_numbers
from camera.uncertainty import with_pose
from detect.circles import candidates_at, disc_shape, first_look, second_looks_at
from detect.discs.rim import DIRECTIONS, STEPS, profiles
from detect.discs.rim_network import OTHERS, SCALES, Networks, RimNetwork
from detect.discs.second_look import FEATURES, GLANCED_AT, glance, pairs_of_steps
from detect.grey_values import estimate_noise
from detect.settings import CircleSettings
from lut import DiscTable, cached_disc_table
from redetect.array_types import BoolArray, ByteArray, Float32Array, FloatArray
from tools.evaluation.disturbances import DISTURBANCES, LOOK_ALIKES, disturbed, replaced
from tools.evaluation.disturbed import BLURRED, Stage, render_scene

_SETTINGS = CircleSettings(polarity="light")
#: There is no second look with these.
_FIRST = CircleSettings(polarity="any")
#: Of a disc, metres.
_RADIUS = 0.1
#: How much a row counts of a rendered building.
_BUILDING_WEIGHT = 3.0
#: How much a row counts that is a disturbed disc, or no disc on a real image.
_DISTURBED_WEIGHT, _REAL_WEIGHT = 0.2, 0.4
#: How much less a disc counts that the first look finds.
_FOUND_WEIGHT = 0.3
#: Evidence of the first look from which on a disc of the real run is one.
_CLEAR = 6.0
#: How often discs of a frame are disturbed, and how many each time.
_ROUNDS, _PER_ROUND = 6, 3
#: How much a row counts of a rendered floor, how often floors change, and the disturbed shares.
_SCENE_WEIGHT, _SCENES_PER_STAGE, _SHARES = 0.4, 50, (0.1, 0.5)
#: Views of each rim, and how far all but the first are off its place (metres) and size (relative).
_VIEWS, _OFF_PLACE, _OFF_SIZE = 5, 0.007, 0.06


def _network_by(features: int, decisive: int, inputs: int) -> RimNetwork:
    """Goes by one feature alone."""
    shapes = (1, 3, inputs, 1), (1, 1), (1, 3, 1, 1), (1, 1), (1, 3 + SCALES, 1), (1, 1)
    out = np.zeros((1, 1 + features), np.float32)
    out[0, 1 + decisive] = 1.0
    weights = [np.zeros(shape, np.float32) for shape in shapes]
    return RimNetwork._make([*weights, out, np.zeros(1, np.float32)])


#: Glances pass; of the looks at one place, the one with most of a rim is the best.
_BY_RIM = Networks(
    _network_by(1, 0, len(GLANCED_AT) + OTHERS),
    _network_by(len(FEATURES), FEATURES.index("rim"), STEPS // 2 + OTHERS),
)
_NOWHERE, _NO_PLACES = np.zeros((0, 4)), np.zeros((0, 2))


class Looks(NamedTuple):
    """Glances at candidates or second looks, of known truth."""

    features: FloatArray  # (N, F)
    grey: Float32Array  # (N, V, K, M)
    pixels_per_radius: Float32Array  # (N, V, K) What the network sees, from V places nearby.
    is_disc: BoolArray  # (N,)
    weight: FloatArray  # (N,)
    source: NDArray[np.str_]  # (N,)


_Row = tuple[FloatArray, FloatArray, FloatArray, bool, float, str]


class _Gathering:
    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.glances: list[_Row] = []
        self.looks: list[_Row] = []

    def add(
        self,
        image: ByteArray,
        view: tuple[Camera, DiscTable],
        discs: FloatArray,
        unsure: FloatArray,
        weight: tuple[float, float],
        source: str,
        only: bool = False,
    ) -> None:
        """Look at an image with discs and unsure places in pixels: u, v, half width and height.

        With `only`, the places are known to be of something else, and nothing else counts.
        """
        camera, table = view
        noise = estimate_noise(image, 32)
        found = first_look(image, camera, table, _FIRST).found
        numbers = camera_numbers(camera)

        def judged(place: FloatArray) -> tuple[bool, float, str]:
            uv = camera.project_floor(place[None])[0]
            near, far = _nearest(uv, discs), _nearest(uv, unsure)
            is_disc, is_other = near < 0.6, far < 0.6 if only else min(near, far) > 1.5
            counts = weight[0] if is_disc else weight[1]
            if is_disc and (np.hypot(*(found.floor_xy - place).T) < _RADIUS).any():
                counts *= _FOUND_WEIGHT
            return is_disc, counts if is_disc or is_other else 0.0, source

        candidates = candidates_at(image, camera, table, _SETTINGS, noise)
        for place, score in zip(candidates.floor_xy, candidates.score, strict=True):
            grey, scale = glance(image, numbers, place[0], place[1], _RADIUS)
            self.glances.append((np.array([score]), grey[None], scale[None], *judged(place)))
        looks = second_looks_at(image, camera, _SETTINGS, candidates, _NO_PLACES, noise, _BY_RIM)
        for features, place in zip(looks.features, looks.floor_xy, strict=True):
            if np.isfinite(features).all():
                self.looks.append((features, *self._views(image, camera, place), *judged(place)))

    def _views(
        self, image: ByteArray, camera: Camera, place: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        grey, scale = np.empty((_VIEWS, DIRECTIONS, STEPS // 2)), np.empty((_VIEWS, DIRECTIONS))
        off = self._rng.normal(size=(_VIEWS, 3)) * [_OFF_PLACE, _OFF_PLACE, _OFF_SIZE]
        off[0] = 0.0
        numbers = camera_numbers(camera)
        for k, (dx, dy, size) in enumerate(off):
            radius = _RADIUS * (1.0 + size)
            steps, scale[k] = profiles(image, numbers, place[0] + dx, place[1] + dy, radius)
            grey[k] = pairs_of_steps(steps)
        return grey, scale


def _looks_of(rows: list[_Row]) -> Looks:
    rows = [row for row in rows if row[4] > 0.0]
    features, grey, scale, is_disc, weight, source = zip(*rows, strict=True)
    return Looks(
        np.array(features), np.array(grey, np.float32), np.array(scale, np.float32),
        np.array(is_disc), np.array(weight), np.array(source),
    )  # fmt: skip


def _nearest(uv: FloatArray, places: FloatArray) -> float:
    if len(places) == 0:
        return np.inf
    off = np.hypot(*((uv - places[:, :2]) / places[:, 2:]).T)
    return float(np.nanmin(off, initial=np.inf))


def _images(camera: Camera, places: FloatArray, slack_px: float) -> FloatArray:
    """(N, 4) pixel, half width and half height of discs."""
    angle = np.linspace(0.0, 2.0 * np.pi, 24)
    rim = _RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rows = []
    for place in places.reshape(-1, 2):
        outline = camera.project_floor(place + rim)
        middle = camera.project_floor(place[None])[0]
        if np.isfinite(outline).all():
            half = np.maximum(np.ptp(outline, axis=0) / 2.0, [3.0, 1.5])
            rows.append([*middle, *(half + slack_px)])
    return np.array(rows).reshape(-1, 4)


def gather(data: Path, every: int, scenes: int, seed: int) -> tuple[Looks, Looks]:
    """Glances and looks at all sources of a folder of data; of the real frames, every n-th."""
    rng = np.random.default_rng(seed)
    gathering = _Gathering(rng)
    _add_scenes(gathering, read_camera(data / "dlr" / "e" / "e.cam"), scenes, rng)
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
            gathering.add(
                image, view, sure, unsure, (_BUILDING_WEIGHT, _BUILDING_WEIGHT), folder.name
            )
            _add_disturbed(gathering, image, view, rng, f"{folder.name} disturbed")
    run = data / "dlr"
    camera = read_camera(run / "e" / "e.cam")
    view = camera, cached_disc_table(camera, disc_shape(_SETTINGS))
    for number, (name, mapped) in enumerate(_mapped(run)):
        path = run / "e" / "images" / f"{name}.jpg"
        if number % every or not path.is_file():
            continue
        image = _read(path)
        found = first_look(image, *view, _FIRST).found
        clear = _images(camera, found.floor_xy[found.evidence > _CLEAR], 0.0)
        gathering.add(image, view, clear, mapped, (_REAL_WEIGHT, _REAL_WEIGHT), "real")
        if number % (3 * every) == 0:
            _add_disturbed(gathering, image, view, rng, "real disturbed")
    return _looks_of(gathering.glances), _looks_of(gathering.looks)


def _add_scenes(
    gathering: _Gathering, camera: Camera, scenes: int, rng: np.random.Generator
) -> None:
    """Look at rendered floors with discs or look-alikes (`tools.evaluation.disturbed`)."""
    view = camera, cached_disc_table(camera, disc_shape(_SETTINGS))
    kinds = [*DISTURBANCES, *DISTURBANCES, *BLURRED, *LOOK_ALIKES]
    for number in range(scenes):
        if number % _SCENES_PER_STAGE == 0:
            stage = Stage(camera, _RADIUS, rng)
        kind = str(rng.choice(kinds))
        image, places = render_scene(stage, kind, rng.uniform(*_SHARES), rng)
        at = _images(camera, np.array(places), 0.0)
        is_disc = kind not in LOOK_ALIKES
        discs, others = (at, _NOWHERE) if is_disc else (_NOWHERE, at)
        weight = (_SCENE_WEIGHT, _SCENE_WEIGHT)
        gathering.add(image, view, discs, others, weight, "scenes", only=not is_disc)


def _add_disturbed(
    gathering: _Gathering,
    image: ByteArray,
    view: tuple[Camera, DiscTable],
    rng: np.random.Generator,
    source: str,
) -> None:
    found = first_look(image, *view, _FIRST).found
    clear = np.flatnonzero(found.evidence > 4.0)
    for i in (i for _ in range(_ROUNDS) for i in rng.permutation(clear)[:_PER_ROUND]):
        at = found.floor_xy[i]
        place = _images(view[0], at, 0.0)
        kind = str(rng.choice(list(DISTURBANCES)))
        changed = disturbed(image, view[1].floor_xy, at, _RADIUS, kind, rng)
        gathering.add(changed, view, place, _NOWHERE, (_DISTURBED_WEIGHT, 0.0), source)
        other = replaced(image, view[1].floor_xy, at, _RADIUS, str(rng.choice(LOOK_ALIKES)), rng)
        if rng.random() < 0.5:
            kind = str(rng.choice(list(DISTURBANCES)))
            other = disturbed(other, view[1].floor_xy, at, _RADIUS, kind, rng)
        gathering.add(other, view, _NOWHERE, place, (0.0, _DISTURBED_WEIGHT), source, only=True)


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


def _read(path: Path) -> ByteArray:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
