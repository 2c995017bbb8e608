"""Candidates of known truth (`detect.discs.judgement`), for training the networks.

They come from rendered buildings and floors with known truth, from boards of many discs, from
photographs of buildings, which discs are painted into and which cover floors, from discs of the
buildings, photographs and real images that were disturbed (`tools.evaluation.disturbances`), and
from a recorded run with its map: there discs are the shipped rows of mapped ones, and what is far
from every mapped disc is none, but for some that the map lacks. Other cameras than the run's see a
part of the floors, the photographs and the boards.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from camera import Camera, read_camera
from camera.kernels import camera_numbers
from camera.uncertainty import with_pose
from detect.circles import candidates_of, classify, scene_of, vote_shape
from detect.discs.judgement import (
    DENSE_RADII,
    FEATURES,
    SPARSE_RADII,
    Outcome,
    pairs_of_steps,
    sparse_profiles,
)
from detect.discs.rim import DIRECTIONS, profiles
from detect.discs.rim_network import OTHERS, SCALES, Networks, RimNetwork
from detect.settings import CircleSettings
from lut import cached_vote_table
from redetect.array_types import BoolArray, ByteArray, Float32Array, FloatArray
from redetect.landmarks import read_frames
from redetect.plane import rotation
from tools.evaluation.disturbances import DISTURBANCES, LOOK_ALIKES, disturbed, replaced, with_disc
from tools.evaluation.disturbed import BLURRED, BORDER, FloorScene, render_scene
from tools.simulator.pixels import noisy_image, subpixel_grid

_SETTINGS = CircleSettings()
#: Of a disc, metres.
_RADIUS = 0.1
#: How much a disc and what is none count: of a rendered building, a disturbed disc, a real image, a
#: rendered floor, a board, a photograph; and how much less what is darker than the floor: nearly
#: all discs there are lighter, but dark ones are to be found elsewhere.
_BUILDING, _DISTURBED, _REAL = (4.0, 4.0), (0.2, 0.2), (2.0, 0.9)
_SCENE, _BOARD, _PHOTOGRAPH, _DARK_OTHERS = (0.15, 0.25), (0.04, 0.2), (0.3, 0.5), 0.1
#: Frames of the recorded run that one process looks at.
_AT_ONCE = 50
#: How often discs of a frame are disturbed, and how many each time.
_ROUNDS, _PER_ROUND = 6, 3
#: How often floors and cameras change, and the disturbed shares.
_IMAGES_PER_SCENE, _SHARES = 50, (0.1, 0.5)
_FARTHEST_M = (4.0, 7.0)  #: Of discs on rendered floors, by turns.
#: How often discs are painted into a photograph (into an image of a rendered building: once), how
#: many, and how far apart.
_PHOTOGRAPH_ROUNDS, _PAINTED, _APART_M = 8, 6, 0.5
#: Photographs that are floors of each scene, and how long an image is there.
_PHOTOGRAPHED_FLOORS, _FLOOR_M = 4, (1.5, 5.0)
#: Share of what is no disc on rendered floors and about boards that is used: there is plenty.
_KEPT = 0.35
#: Views of each rim, and how far all but the first are off its place (metres) and size (relative).
_VIEWS, _OFF_PLACE, _OFF_SIZE = 5, 0.007, 0.06
#: A disc of fewer pixels than this from its middle up is not told from others.
_LEAST_HALF_PX = 1.0
#: Sizes of images of other cameras.
_SIZES = (640, 480), (512, 384), (320, 240)


def _network_by(features: int, decisive: int, inputs: int) -> RimNetwork:
    """Goes by one feature alone."""
    shapes = (1, 3, inputs, 1), (1, 1), (1, 3, 1, 1), (1, 1), (1, 3 + SCALES, 1), (1, 1)
    out = np.zeros((1, 1 + features), np.float32)
    out[0, 1 + decisive] = 1.0
    weights = [np.zeros(shape, np.float32) for shape in shapes]
    return RimNetwork._make([*weights, out, np.zeros(1, np.float32)])


#: All pass the prescreening; of the rims at one place, the one with most of a rim is the best.
_BY_RIM = Networks(
    _network_by(1, 0, len(SPARSE_RADII) + OTHERS),
    _network_by(len(FEATURES), FEATURES.index("rim"), len(DENSE_RADII) + OTHERS),
)


class Samples(NamedTuple):
    """Profiles of candidates, sparse ones or those of rims, of known truth."""

    features: FloatArray  # (N, F)
    grey: Float32Array  # (N, V, K, M) Of a dark disc, turned into a light one.
    pixels_per_radius: Float32Array  # (N, V, K) What the network sees, from V places nearby.
    is_disc: BoolArray  # (N,)
    weight: FloatArray  # (N,)


#: Discs of the recorded run that are not mapped, and what may be one, found by looking at images.
_UNMAPPED = Path(__file__).with_name("unmapped.csv")

_NOWHERE = np.zeros((0, 4))


class Truth(NamedTuple):
    """What is known of an image; places are (N, 4) pixels u, v, half width and height."""

    light: FloatArray = _NOWHERE  # discs that are lighter than the floor,
    dark: FloatArray = _NOWHERE  # and darker
    unsure: FloatArray = _NOWHERE
    others: FloatArray | None = None  # where nothing is a disc; None: wherever else


_Row = tuple[FloatArray, FloatArray, FloatArray, bool, float]


class _Gathering:
    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.sparse: list[_Row] = []
        self.rims: list[_Row] = []

    def add(
        self, image: ByteArray, camera: Camera, truth: Truth, weight: tuple[float, float],
        dark_others: float = 1.0, kept: float = 1.0,
    ) -> None:  # fmt: skip
        """Look at an image; a share of what is no disc is kept, and all of `truth.others`."""
        kept = kept if truth.others is None else 1.0
        table = cached_vote_table(camera, vote_shape(_SETTINGS))
        scene = scene_of(image, camera, table, _SETTINGS)

        def known(places: FloatArray, sign: FloatArray) -> Iterator[tuple[int, bool, float]]:
            for k, uv in enumerate(camera.project_floor(places)):
                discs = truth.light if sign[k] > 0.0 else truth.dark
                is_disc = _nearest(uv, discs) < 0.6
                elsewhere = min(_nearest(uv, discs), _nearest(uv, truth.unsure)) > 1.5
                if truth.others is not None:
                    elsewhere = _nearest(uv, truth.others) < 0.6
                if is_disc or (elsewhere and self._rng.random() < kept):
                    less = dark_others if sign[k] < 0.0 else 1.0
                    yield k, is_disc, weight[0] if is_disc else less * weight[1] / kept

        candidates = candidates_of(scene, table, _SETTINGS)
        grey, scale = sparse_profiles(image, scene.camera_numbers, candidates.floor_xy, _RADIUS)
        grey = _as_light(grey, candidates.sign[:, None, None])
        for k, *row in known(candidates.floor_xy, candidates.sign):
            seen: tuple[Any, ...] = candidates.score[k, None], grey[k, None], scale[k, None]
            self.sparse.append((*seen, *row))
        rims = classify(scene, _SETTINGS, candidates, _BY_RIM)
        rims = rims.where((rims.outcome == Outcome.JUDGED) & np.isfinite(rims.features).all(axis=1))
        for k, *row in known(rims.floor_xy, rims.sign):
            views = self._views(image, camera, rims.floor_xy[k], rims.sign[k])
            seen = rims.features[k], *views
            self.rims.append((*seen, *row))

    def _views(
        self, image: ByteArray, camera: Camera, place: FloatArray, sign: float
    ) -> tuple[Float32Array, Float32Array]:
        grey = np.empty((_VIEWS, DIRECTIONS, len(DENSE_RADII)), np.float32)
        scale = np.empty((_VIEWS, DIRECTIONS), np.float32)
        off = self._rng.normal(size=(_VIEWS, 3)) * [_OFF_PLACE, _OFF_PLACE, _OFF_SIZE]
        off[0] = 0.0
        numbers = camera_numbers(camera)
        for k, (dx, dy, size) in enumerate(off):
            radius = _RADIUS * (1.0 + size)
            radial = profiles(image, numbers, place[None] + (dx, dy), np.full(1, radius))
            grey[k] = _as_light(pairs_of_steps(radial.grey[0]), sign)
            scale[k] = radial.pixels_per_radius[0]
        return grey, scale


def _as_light(grey: Float32Array, sign: FloatArray | float) -> Float32Array:
    """Grey values at discs as of light ones; `sign` is -1 for dark ones."""
    return np.asarray(np.where(np.asarray(sign) > 0.0, grey, 255.0 - grey), np.float32)


def _samples_of(rows: list[_Row]) -> Samples:
    features, grey, scale, is_disc, weight = zip(*rows, strict=True)
    return Samples(
        np.array(features), np.array(grey, np.float32), np.array(scale, np.float32),
        np.array(is_disc), np.array(weight),
    )  # fmt: skip


def _nearest(uv: FloatArray, places: FloatArray) -> float:
    if len(places) == 0:
        return np.inf
    off = np.hypot(*((uv - places[:, :2]) / places[:, 2:]).T)
    return float(np.nanmin(off, initial=np.inf))


def _images(camera: Camera, places: FloatArray, slack_px: float = 0.0) -> FloatArray:
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


def gather(
    data: Path, frames: slice, scenes: int, seed: int, without: str = ""
) -> tuple[Samples, Samples]:
    """Sparse profiles and rims from a folder of data, and from some frames of its recorded run.

    A rendered building may be left out.
    """
    camera = read_camera(data / "dlr" / "e" / "e.cam")
    kinds = [*DISTURBANCES, *DISTURBANCES, *[BORDER] * 4, *BLURRED, *LOOK_ALIKES]
    photographs = sorted((data / "york").glob("dev/*/images/*"))
    recorded = [
        (data / "dlr" / "e" / "images" / f"{name}.jpg", mapped, shipped)
        for name, mapped, shipped in _mapped(data / "dlr", camera)
    ]
    buildings = [of for of in sorted((data / "rendered").glob("r*")) if of.name != without]
    recorded = [frame for frame in recorded[frames] if frame[0].is_file()]
    parts: list[tuple[Any, ...]] = [
        *(
            (_scenes, camera, kinds, photographs, _IMAGES_PER_SCENE)
            for _ in range(scenes // _IMAGES_PER_SCENE)
        ),
        *(
            (_boards, photographs, _IMAGES_PER_SCENE // 5)
            for _ in range(scenes // _IMAGES_PER_SCENE)
        ),
        *((_photograph, folder) for folder in sorted((data / "york").glob("dev/*/"))),
        *((_building, folder) for folder in buildings),
        *((_real, camera, recorded[k : k + _AT_ONCE]) for k in range(0, len(recorded), _AT_ONCE)),
    ]
    with ProcessPoolExecutor() as pool:
        done = [pool.submit(_gather, [seed, n], *part) for n, part in enumerate(parts)]
        rows = [future.result() for future in done]
    sparse, rims = (_samples_of([row for part in rows for row in part[which]]) for which in (0, 1))
    return sparse, rims


def _gather(seed: list[int], add: Any, *of: Any) -> tuple[list[_Row], list[_Row]]:
    """The sparse profiles and the rims that a part of the sources gives."""
    rng = np.random.default_rng(seed)
    gathering = _Gathering(rng)
    add(gathering, rng, seed[1], *of)
    return gathering.sparse, gathering.rims


def _scenes(
    gathering: _Gathering, rng: np.random.Generator, number: int, camera: Camera,
    kinds: list[str], photographs: list[Path], count: int,
) -> None:  # fmt: skip
    """Look at rendered floors with discs or look-alikes (`tools.evaluation.disturbed`)."""
    farthest_m = _FARTHEST_M[number // 2 % 2]
    scene = FloorScene(camera if number % 2 == 0 else other_camera(rng), _RADIUS, rng, farthest_m)
    for path in rng.choice(np.array(photographs), _PHOTOGRAPHED_FLOORS):
        scene.floors[path.stem] = _photographed(_read(path), scene.floor_xy, rng)
    for _ in range(count):
        kind = str(rng.choice(kinds))
        image, places = render_scene(scene, kind, rng.uniform(*_SHARES), rng)
        at = _images(scene.camera, np.array(places))
        if kind in LOOK_ALIKES:
            truth = Truth(others=at)
        else:
            heights = np.array([np.ptp(scene.outline(place)[:, 1]) for place in places])
            clear = heights >= 2.0 * _LEAST_HALF_PX
            clear &= np.array([_contrast(image, scene.camera, at) for at in places]) > 6.0
            truth = Truth(at[clear], unsure=at[~clear])
        gathering.add(image, scene.camera, truth, _SCENE, _DARK_OTHERS, _KEPT)


def _photographed(
    photograph: ByteArray, floor_xy: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Grey values of a floor that is covered with a photograph, again and again."""
    angle, length = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*_FLOOR_M)
    turned = np.nan_to_num(floor_xy) @ rotation(angle)
    height, width = photograph.shape
    at = np.asarray(np.clip(turned, -50.0, 50.0) * (width / length) + 60.0 * width, np.float32)
    # Mirrored, so that there are no seams.
    u = np.abs(np.mod(at[..., 0], 2.0 * width) - width)
    v = np.abs(np.mod(at[..., 1], 2.0 * height) - height)
    seen = cv2.remap(photograph, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(rng.uniform(100.0, 200.0) * (seen / 255.0) ** rng.uniform(0.8, 1.8))


def _boards(
    gathering: _Gathering, rng: np.random.Generator, _: int, photographs: list[Path], count: int
) -> None:
    """Look at boards, every second one with light discs."""
    for k in range(count):
        path = photographs[rng.integers(len(photographs))]
        image, camera, places = render_disc_board(_read(path), rng)
        at = _images(camera, places)
        truth = Truth(dark=at)
        if k % 2:
            image, truth = np.asarray(255 - image, np.uint8), Truth(light=at)
        gathering.add(image, camera, truth, _BOARD, kept=_KEPT)


def _building(gathering: _Gathering, rng: np.random.Generator, _: int, folder: Path) -> None:
    """Look at a rendered building, as it is and with its discs disturbed."""
    camera = read_camera(folder / f"{folder.name}.cam")
    for frame in json.loads((folder / "truth.json").read_text())["frames"]:
        image = _read(folder / "images" / f"{frame['prefix']}.jpg")
        # The building's camera tilts: what counts is where discs are in the image.
        seen = camera.floor_from_pixel(np.array([[c["u"], c["v"]] for c in frame["circles"]]))
        sure = np.array([c["mandatory"] for c in frame["circles"]], np.bool_)
        truth = Truth(_images(camera, seen[sure]), unsure=_images(camera, seen[~sure]))
        gathering.add(image, camera, truth, _BUILDING, _DARK_OTHERS)
        _add_disturbed(gathering, image, camera, seen[sure], rng)
        _add_painted(gathering, image, camera, seen, rng)


def _photograph(gathering: _Gathering, rng: np.random.Generator, _: int, folder: Path) -> None:
    """Look at a photograph of a building, as it is and with discs on its floor."""
    camera = read_camera(folder / f"{folder.name}.cam")
    photograph = _read(folder / "images" / f"{folder.name}.jpg")
    gathering.add(photograph, camera, Truth(), _PHOTOGRAPH, _DARK_OTHERS)
    for _ in range(_PHOTOGRAPH_ROUNDS):
        grey = 255.0 * (photograph / 255.0) ** rng.uniform(0.7, 1.5)
        blurred = cv2.GaussianBlur(grey, (0, 0), rng.uniform(0.3, 1.2))
        image = np.asarray(np.rint(blurred), np.uint8)
        _add_painted(gathering, image, camera, np.zeros((0, 2)), rng)


def _add_painted(
    gathering: _Gathering, image: ByteArray, camera: Camera, known: FloatArray,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Look at an image with more discs on the floor than are `known` (N, 2), also disturbed."""
    floor_xy = cached_vote_table(camera, vote_shape(_SETTINGS)).floor_xy
    pixels = rng.uniform(0.0, [camera.width, camera.height], (200, 2))
    places: list[FloatArray] = []
    for place in camera.floor_from_pixel(pixels):
        apart = all(np.hypot(*(place - other)) > _APART_M for other in [*known, *places])
        seen = _images(camera, place)
        if apart and len(seen) > 0 and seen[0, 3] > 1.5 * _LEAST_HALF_PX:
            places.append(place)
            image = with_disc(image, floor_xy, place, _RADIUS, rng)
        if len(places) == _PAINTED:
            break
    at = np.array(places).reshape(-1, 2)
    truth = Truth(_images(camera, at), unsure=_images(camera, known))
    gathering.add(image, camera, truth, _PHOTOGRAPH, _DARK_OTHERS)
    _add_disturbed(gathering, image, camera, at, rng)


def _real(
    gathering: _Gathering, rng: np.random.Generator, _: int, camera: Camera,
    frames: list[tuple[Path, FloatArray, FloatArray]],
) -> None:  # fmt: skip
    """Look at frames of the recorded run, and at some of them with their discs disturbed."""
    for number, (path, mapped, rows_xy) in enumerate(frames):
        image = _read(path)
        is_mapped = [_nearest(uv, mapped) < 1.0 for uv in camera.project_floor(rows_xy)]
        shipped = rows_xy[np.array(is_mapped, np.bool_)]
        light = np.array([_contrast(image, camera, xy) for xy in shipped]) > 0.0
        of_light, of_dark = (_images(camera, shipped[of]) for of in (light, ~light))
        truth = Truth(of_light, of_dark, mapped)
        gathering.add(image, camera, truth, _REAL, _DARK_OTHERS)
        if number % 6 == 0:
            _add_disturbed(gathering, image, camera, shipped[light], rng)


def other_camera(rng: np.random.Generator) -> Camera:
    """A camera of another size, height and angle over the floor."""
    width, height = _SIZES[rng.integers(len(_SIZES))]
    scale, pitch = width * rng.uniform(0.55, 1.1), np.radians(rng.uniform(15.0, 60.0))
    cos, sin = np.cos(pitch), np.sin(pitch)
    pose = (-1.0, 0.0, 0.0, 0.0), (0.0, sin, -cos, 0.0), (0.0, -cos, -sin, rng.uniform(0.4, 1.7))
    middle = (width - 1) / 2.0, (height - 1) / 2.0
    return Camera(width, height, scale, scale, *middle, (0.0,) * 5, pose)


def render_disc_board(
    photograph: ByteArray, rng: np.random.Generator
) -> tuple[ByteArray, Camera, FloatArray]:
    """A board of many dark discs before a part of a photograph; its camera and (N, 2) places.

    The board lies on the floor, below a camera that looks down at it at some angle.
    """
    width, height = _SIZES[rng.integers(len(_SIZES))]
    scale, pitch = width * rng.uniform(0.7, 1.6), np.radians(rng.uniform(35.0, 90.0))
    columns, rows = rng.integers(4, 14, 2)
    spacing = _RADIUS * rng.uniform(2.3, 4.0)
    size = np.array([columns - 1, rows - 1]) * spacing
    away = scale * np.hypot(*size) / (height * rng.uniform(0.3, 1.2))
    cos, sin = np.cos(pitch), np.sin(pitch)
    pose = (-1.0, 0.0, 0.0, 0.0), (0.0, sin, -cos, cos * away), (0.0, -cos, -sin, sin * away)
    middle = (width - 1) / 2.0, (height - 1) / 2.0
    camera = Camera(width, height, scale, scale, *middle, (0.0,) * 5, pose)
    fine = 3
    pixels = subpixel_grid(camera, fine, fine)
    floor = camera.floor_from_pixel(pixels)
    matrix = rotation(rng.uniform(-np.pi, np.pi))
    at = np.nan_to_num(floor @ matrix, nan=1e6) + size / 2.0
    index = np.clip(np.rint(at / spacing), 0, [columns - 1, rows - 1])
    shifted = rng.random() < 0.4  # every second row by half of the spacing
    if shifted:
        row = np.clip(np.rint(at[..., 1] / spacing), 0, rows - 1)
        across = np.clip(np.rint(at[..., 0] / spacing - 0.5 * (row % 2)), 0, columns - 1)
        index = np.stack([across + 0.5 * (row % 2), row], axis=-1)
    off = np.hypot(*np.moveaxis(at - index * spacing, -1, 0))
    margin = rng.uniform(0.15, 0.6)
    on_board = ((at > -margin) & (at < size + margin + 0.5 * spacing * shifted)).all(axis=-1)
    zoom = rng.uniform(0.5, 1.0, 2) * photograph.shape
    top, left = rng.uniform(0.0, photograph.shape - zoom)
    part = photograph[int(top) : int(top + zoom[0]), int(left) : int(left + zoom[1])]
    behind = cv2.resize(part, (width * fine, height * fine), interpolation=cv2.INTER_CUBIC)
    behind = behind * rng.uniform(0.3, 1.0)
    paper = rng.uniform(90.0, 240.0)
    ink = paper * rng.uniform(0.1, 0.8)
    grey = np.where(on_board, np.where(off < _RADIUS, ink, paper), behind)
    slope = rng.uniform(-0.3, 0.3, 2)
    light = 1.0 + slope[0] * pixels[..., 0] / width + slope[1] * pixels[..., 1] / height
    sigma = fine * rng.uniform(0.4, 2.5)
    seen = cv2.GaussianBlur((grey * light).astype(np.float32), (0, 0), sigma)
    averaged = np.asarray(cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA))
    image = noisy_image(averaged, rng.uniform(0.5, 5.0), rng)
    number = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(float)
    if shifted:
        number[..., 0] += 0.5 * (number[..., 1] % 2)
    places = (number.reshape(-1, 2) * spacing - size / 2.0) @ matrix.T
    return image, camera, places


def _add_disturbed(
    gathering: _Gathering, image: ByteArray, camera: Camera, places: FloatArray,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Look at an image of which light discs (N, 2) are disturbed or replaced, a few at a time."""
    floor_xy = cached_vote_table(camera, vote_shape(_SETTINGS)).floor_xy
    turns = (rng.permutation(len(places))[:_PER_ROUND] for _ in range(_ROUNDS))
    for at in (places[i] for turn in turns for i in turn):
        place = _images(camera, at)
        kind = str(rng.choice(list(DISTURBANCES)))
        changed = disturbed(image, floor_xy, at, _RADIUS, kind, rng)
        disc = Truth(place, others=_NOWHERE)
        gathering.add(changed, camera, disc, _DISTURBED)
        other = replaced(image, floor_xy, at, _RADIUS, str(rng.choice(LOOK_ALIKES)), rng)
        if rng.random() < 0.5:
            kind = str(rng.choice(list(DISTURBANCES)))
            other = disturbed(other, floor_xy, at, _RADIUS, kind, rng)
        gathering.add(other, camera, Truth(others=place), _DISTURBED)


def _mapped(run: Path, camera: Camera) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Names of frames, places of mapped discs in the image with slack, and shipped rows (m)."""
    true = np.array(json.loads((run / "mounting.json").read_text())["robot_from_camera"])
    rows = list(csv.DictReader((run / "levelled_map.csv").open()))
    rows += csv.DictReader(_UNMAPPED.open())
    discs = np.array([(float(d["x_m"]), float(d["y_m"])) for d in rows])
    shipped = {
        frame.step.prefix.split("/")[-1].rsplit(".ppm", 1)[0]: np.array(
            [(c.px, c.py) for c in frame.circles if c.ids and c.ids[0] >= 0]
        ).reshape(-1, 2)
        for frame in read_frames(run / "map.circles")
    }
    seen = with_pose(camera, true)
    for pose in csv.DictReader((run / "levelled_path.csv").open()):
        if not pose["prefix"][-4:].isdigit():
            continue
        x, y, turn = (float(pose[k]) for k in ("x_m", "y_m", "theta_rad"))
        cos, sin = np.cos(turn), np.sin(turn)
        places = (discs - [x, y]) @ [[cos, -sin], [sin, cos]]
        near = places[np.hypot(*places.T) < 9.5]
        yield pose["prefix"], _images(seen, near, 4.0), shipped[pose["prefix"]]


def _contrast(image: ByteArray, camera: Camera, floor_xy: FloatArray) -> float:
    """Grey levels by which a disc (2,) is lighter than the floor."""
    [grey], _ = sparse_profiles(image, camera_numbers(camera), floor_xy[None], _RADIUS)
    return float(np.nanmean(grey[:, 1:3]) - np.nanmean(grey[:, 5:7]))


def _read(path: Path) -> ByteArray:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
