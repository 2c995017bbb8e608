"""Simulated runs: their plan, their frames, and their folders in the data set's layout."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np

from camera import Camera, parse_camera, write_camera
from camera.model import PARAMETERS
from camera.uncertainty import with_covariance
from redetect.array_types import BoolArray, ByteArray, FloatArray, IntArray
from redetect.landmarks import CircleLandmark, Frame, Landmark, LineLandmark, write_frames
from redetect.storage import write_bytes
from tools.published_camera import PUBLISHED_CAM
from tools.simulator.building import EXTENT
from tools.simulator.driving import (
    DriveStyle,
    drive,
    measured_steps,
    robot_tilt,
    step_record,
    tilted_camera,
)
from tools.simulator.files import encoded, rounded, write_truth
from tools.simulator.furniture import DISC_RADIUS_M, lay_discs
from tools.simulator.observation import (
    SeenDisc,
    SeenEdge,
    circle_row,
    line_row,
    see_discs,
    see_edges,
)
from tools.simulator.office import build_office, is_outside, office_route
from tools.simulator.parallel import in_order
from tools.simulator.renderer import Sensor, grey_values, render_light, smeared
from tools.simulator.scene import Scene, UprightEdge, make_scene

_SUN = (0.30, -0.70, 0.50, 3.0)
_SKY = 3.0


@dataclass(frozen=True)
class RunSettings:
    """Settings of a simulated run."""

    name: str = "sim"
    frames: int = 3297
    seed: int = 1
    discs: int = 576
    lookalikes: int = 140
    visits: float = 0.6  # Probability that a room with an open door is visited.
    skip: int = 0  # Number of steps of the drive before the first frame.
    unlabelled: float = 0.03  # Share of rows with unknown ID (-1).
    camera_text: str = PUBLISHED_CAM
    """Text of the calibration (.cam) through which the run is seen."""
    style: DriveStyle = field(default_factory=DriveStyle)
    sensor: Sensor = field(default_factory=Sensor)


@dataclass(frozen=True)
class RunPlan:
    """A run that only has to be rendered."""

    settings: RunSettings
    camera: Camera
    scene: Scene
    edges: list[UprightEdge]
    pictures: list[tuple[float, float, float, float, float, float]]
    disc_ids: IntArray
    disc_xy: FloatArray
    lookalikes: list[tuple[str, float, float]]
    poses: FloatArray  # (frames + 1, 3) true poses: before the first step and after each.
    tilts_rad: FloatArray  # (frames, 2) tilt (p, q) at each frame.
    steps: FloatArray  # (frames, 3) odometry.
    wrong_odometry: BoolArray
    """(frames,) whether the odometry of the step is beyond its covariance."""
    unlabelled: BoolArray  # (frames, discs) whether a row would not know the disc's ID.

    def true_camera(self, frame: int) -> Camera:
        """The camera as it is mounted at a frame, tilt included."""
        return tilted_camera(self.camera, self.tilts_rad[frame])

    def prefix(self, frame: int) -> str:
        """Name of a frame's image, without extension."""
        return f"{self.settings.name}.{frame:04d}"


Purpose = Literal["building", "route", "drive", "marks", "tilt", "odometry", "labels", "rows"]
_PURPOSES = get_args(Purpose)


def random_for(seed: int, purpose: Purpose) -> np.random.Generator:
    """A stream of random numbers of its own for each purpose: changing one leaves the others."""
    return np.random.default_rng(np.random.SeedSequence([seed, _PURPOSES.index(purpose)]))


def plan_run(settings: RunSettings, *, lit: bool = True) -> RunPlan:
    """Build the office, lay the discs and drive through it."""
    seed, frames = settings.seed, settings.frames
    camera = parse_camera(settings.camera_text, "the calibration")
    office = build_office(random_for(seed, "building"))
    corners = office_route(office, random_for(seed, "route"), settings.visits)
    driven = drive(corners, settings.skip + frames, settings.style, random_for(seed, "drive"))
    poses = driven[settings.skip :]
    lay_discs(
        office.building, poses, settings.discs, settings.lookalikes, random_for(seed, "marks"),
        EXTENT,
    )  # fmt: skip
    scene = make_scene(
        office.building, EXTENT, office.floor_kind, office.floorings, office.indoors, _SUN, _SKY,
        lit=lit,
    )  # fmt: skip
    discs = [m for m in office.building.marks if m.disc_id >= 0]
    wrong = is_outside(poses[1:]) | is_outside(poses[:-1])
    chance = random_for(seed, "labels").random((frames, len(discs)))
    return RunPlan(
        settings=settings,
        camera=camera,
        scene=scene,
        edges=office.building.distinct_edges(),
        pictures=office.building.pictures,
        disc_ids=np.array([m.disc_id for m in discs], dtype=np.int64),
        disc_xy=np.array([[m.x, m.y] for m in discs]).reshape(-1, 2),
        lookalikes=[(m.label, m.x, m.y) for m in office.building.marks if m.disc_id < 0],
        poses=poses,
        tilts_rad=robot_tilt(frames, settings.style, random_for(seed, "tilt")),
        steps=measured_steps(poses, random_for(seed, "odometry"), wrong),
        wrong_odometry=wrong,
        unlabelled=chance < settings.unlabelled,
    )


#: 80 frames: along a corridor, into a room with sunlit windows, back and on along the corridor.
DEMO = RunSettings(
    name="e",
    frames=80,
    seed=8,
    discs=32,
    lookalikes=16,
    visits=0.8,
    style=DriveStyle(step_m=0.25, tilt_deg=0.5),
    sensor=Sensor(jpeg_quality=85),
)


SIMULATED = """\
SIMULATED, rendered by tools/simulator ({what}): no real robot drove here.
The real data set (runs c, d, e and g of the DLR Spatial Cognition data set, with images) is
published on the page DlrSpatialCognitionDataSet of the University of Bremen's group AG EBV; its run
folders have the same layout and take the place of this one unchanged.
"""

_STEP_FORMAT = """\
The robot coordinate system is located in the robot's center with -Y pointing forward and X pointing
left.
STEP <image> <dX> <dY> <dPhi> <cXX> <cXY> <cYY> <cXPhi> <cYPhi> <cPhiPhi>
A movement by odometry; the image was taken after it. Metres and radians."""

_CIRCLE_FORMAT = """\
LANDMARK_C <pX> <pY> <quality> <cXX> <cXY> <cYY> <ID>
A disc that is truly in view, at its true place in the level robot frame. The covariance is the
published detector's for that place in the image, the quality the published one there.
ID -1: unknown."""

_NOISY_CIRCLE_FORMAT = """\
LANDMARK_C <pX> <pY> <quality> <cXX> <cXY> <cYY> <ID>
A disc that is in view, at its true place in the level robot frame plus an error drawn from the
covariance. Quality is always 1: there are no images. ID -1: unknown."""

_LINE_FORMAT = """\
LANDMARK_L <xtop> <ytop> <xbottom> <ybottom> <alpha> <beta> <quality> <sigma> <ID>
A vertical edge that is truly in view where it crosses the horizon, and clear: its ends in
undistorted normalised image coordinates, its true bearing, its inclination as the (level)
calibration measures it, one pixel as standard deviation."""


_UNLISTED_FORMAT = """\
LANDMARK_C <pX> <pY> 1 <cXX> <cXY> <cYY> <ID>
A disc that is at least partly in view but not listed in map.circles: nearly hidden, cut, or far."""

_UNLISTED_LINES_FORMAT = """\
LANDMARK_L <xtop> <ytop> <xbottom> <ybottom> <alpha> <beta> <quality> <sigma> <ID>
A vertical edge that shows in the image but is not listed in map.lines: it does not cross the
horizon, is short, faint or beside another one. Columns as there."""

#: Least step across such an edge (grey values) and rows that show it: what a detector may find.
_LEAST_STEP, _LEAST_ROWS = 4.0, 12

_LOOKALIKE_FORMAT = """\
LANDMARK_C <pX> <pY> 1 <cXX> <cXY> <cYY> <number>
Something at least partly in view that looks like a disc but is none; truth.json says what."""

#: Variance of the places in these two files, which are exact: a gate, square metres.
_NOMINAL_VARIANCE = 0.04**2


@dataclass(frozen=True)
class FrameTruth:
    """What is truly in view in one frame, and the image's bytes if there is one."""

    frame: int
    jpeg: bytes | None
    circles: tuple[CircleLandmark, ...]
    lines: tuple[LineLandmark, ...]
    discs: tuple[SeenDisc, ...]
    edges: tuple[SeenEdge, ...]
    lookalikes: tuple[SeenDisc, ...]


def render_frame(plan: RunPlan, frame: int) -> FrameTruth:
    """Render one frame of a run, with its truth."""
    # Its own random numbers, whatever was rendered before it.
    seed = np.random.SeedSequence([plan.settings.seed, len(_PURPOSES), frame])
    rng = np.random.default_rng(seed)
    camera = plan.true_camera(frame)
    pose = plan.poses[frame + 1]
    light = render_light(plan.scene, camera, pose)
    # The robot keeps its motion; half of the exposure is after its middle.
    onward = pose + 0.5 * plan.settings.sensor.exposure * (pose - plan.poses[frame])
    radiance = smeared(light, camera, pose, onward)
    grey = grey_values(radiance, plan.settings.sensor, rng)
    jpeg = encoded(grey, quality=plan.settings.sensor.jpeg_quality)
    decoded = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    return _truth(plan, frame, jpeg, np.asarray(decoded, dtype=np.uint8))


def _truth(plan: RunPlan, frame: int, jpeg: bytes | None, grey: ByteArray | None) -> FrameTruth:
    camera, pose = plan.true_camera(frame), plan.poses[frame + 1]
    seen = partial(see_discs, plan.scene, plan.camera, camera, pose, radius_m=DISC_RADIUS_M)
    discs = seen(plan.disc_ids, plan.disc_xy)
    # What looks like a disc counts by its number in the plan.
    alike_xy = np.array([(x, y) for _, x, y in plan.lookalikes]).reshape(-1, 2)
    edges = [] if grey is None else see_edges(plan.scene, camera, pose, plan.edges, grey)
    unknown = {int(disc) for disc in plan.disc_ids[plan.unlabelled[frame]]}
    return FrameTruth(
        frame=frame,
        jpeg=jpeg,
        circles=tuple(
            circle_row(d, plan.camera, grey, -1 if d.disc_id in unknown else d.disc_id)
            for d in discs
            if d.listed
        ),
        lines=tuple(line_row(e, plan.camera) for e in edges if e.listed),
        discs=tuple(discs),
        edges=tuple(edges),
        lookalikes=tuple(seen(np.arange(len(alike_xy)), alike_xy)),
    )


def write_run(
    settings: RunSettings, folder: Path, *, jobs: int = 1, overwrite: bool = False
) -> int:
    """Render a run and write its folder, which should have its name; returns the disc rows' number.

    `overwrite`: whether existing files may be replaced.

    Raises
    ------
    redetect.storage.OutputExistsError
        If a file exists and may not be replaced.
    """
    plan = plan_run(settings)
    what = f"run {settings.name}, seed {settings.seed}, {settings.frames} frames"
    if settings.skip:
        what += f" after {settings.skip} skipped"
    (folder / "images").mkdir(parents=True, exist_ok=True)
    truths: list[FrameTruth] = []
    for truth in in_order(partial(render_frame, plan), range(settings.frames), jobs):
        assert truth.jpeg is not None
        image = folder / "images" / f"{plan.prefix(truth.frame)}.jpg"
        write_bytes(image, truth.jpeg, overwrite=overwrite)
        # The bytes of all images need not be kept.
        truths.append(replace(truth, jpeg=None))
    circles = [t.circles for t in truths]
    _write_seen(plan, folder, what, (_CIRCLE_FORMAT, circles), truths, overwrite)
    lines = [t.lines for t in truths]
    _write_landmarks(plan, folder / "map.lines", what, _LINE_FORMAT, lines, overwrite)
    _write_beside(plan, folder, what, truths, overwrite)
    return sum(map(len, circles))


def _write_seen(
    plan: RunPlan, folder: Path, what: str, circles: tuple[str, Sequence[tuple[Landmark, ...]]],
    truths: list[FrameTruth], overwrite: bool,
) -> None:  # fmt: skip
    """Write calibration, odometry, the rows of discs (below their description) and the truth."""
    name = plan.settings.name
    exact = with_covariance(plan.camera, np.zeros((PARAMETERS, PARAMETERS)))
    write_camera(exact, folder / f"{name}.cam", overwrite=overwrite)
    no_rows: list[tuple[Landmark, ...]] = [() for _ in truths]
    _write_landmarks(plan, folder / f"{name}.txt", what, "", no_rows, overwrite)
    _write_landmarks(plan, folder / "map.circles", what, *circles, overwrite)
    head, lists = _truth_of(plan, truths, what)
    write_truth(folder / "truth.json", head, lists, overwrite=overwrite)


def _write_beside(
    plan: RunPlan, folder: Path, what: str, truths: Sequence[FrameTruth], overwrite: bool
) -> None:
    """Write what is in view besides the listed discs, as `detect compare` reads it."""
    unlisted = [tuple(_nominal_row(d) for d in truth.discs if not d.listed) for truth in truths]
    lookalikes = [tuple(map(_nominal_row, truth.lookalikes)) for truth in truths]
    for name, text, rows in (
        ("unlisted.circles", _UNLISTED_FORMAT, unlisted),
        ("lookalikes.circles", _LOOKALIKE_FORMAT, lookalikes),
    ):
        _write_landmarks(plan, folder / name, what, text, rows, overwrite)
    if any(truth.edges for truth in truths):
        edges = [
            tuple(line_row(e, plan.camera) for e in truth.edges if not e.listed and _shows(e))
            for truth in truths
        ]
        place = folder / "unlisted.lines"
        _write_landmarks(plan, place, what, _UNLISTED_LINES_FORMAT, edges, overwrite)


def _shows(edge: SeenEdge) -> bool:
    return abs(edge.contrast) >= _LEAST_STEP and edge.rows >= _LEAST_ROWS


def _nominal_row(disc: SeenDisc) -> CircleLandmark:
    x, y = disc.robot_xy.tolist()
    return CircleLandmark(x, y, 1.0, _NOMINAL_VARIANCE, 0.0, _NOMINAL_VARIANCE, (disc.disc_id,))


def write_rows(
    settings: RunSettings, folder: Path, *, noisy: bool = True, miss: float = 0.0,
    overwrite: bool = False,
) -> int:  # fmt: skip
    """Write a run without images: odometry, and disc rows with or without measurement noise."""
    plan = plan_run(settings, lit=False)
    rng = random_for(settings.seed, "rows")
    truths = [_truth(plan, frame, None, None) for frame in range(settings.frames)]
    rows: list[tuple[CircleLandmark, ...]] = []
    for truth in truths:
        kept = [row for row in truth.circles if rng.random() >= miss]
        rows.append(tuple(_disturbed(row, rng) for row in kept) if noisy else tuple(kept))
    folder.mkdir(parents=True, exist_ok=True)
    what = f"run {settings.name}, seed {settings.seed}, {settings.frames} steps, no images"
    text = _NOISY_CIRCLE_FORMAT if noisy else _CIRCLE_FORMAT
    _write_seen(plan, folder, what, (text, rows), truths, overwrite)
    return sum(map(len, rows))


def _disturbed(row: CircleLandmark, rng: np.random.Generator) -> CircleLandmark:
    covariance = np.array([[row.cxx, row.cxy], [row.cxy, row.cyy]])
    dx, dy = np.linalg.cholesky(covariance) @ rng.standard_normal(2)
    return replace(row, px=row.px + float(dx), py=row.py + float(dy))


def _write_landmarks(
    plan: RunPlan, path: Path, what: str, row_format: str, rows: Iterable[tuple[Landmark, ...]],
    overwrite: bool,
) -> None:  # fmt: skip
    head = "\n".join(
        part for part in (SIMULATED.format(what=what).rstrip(), "", _STEP_FORMAT, row_format)
    ).rstrip()
    frames = (
        Frame(step_record(plan.prefix(k), plan.steps[k]), landmarks)
        for k, landmarks in enumerate(rows)
    )
    write_frames(path, frames, head=head, overwrite=overwrite)


def _truth_of(
    plan: RunPlan, truths: list[FrameTruth], what: str
) -> tuple[dict[str, Any], dict[str, list[Any]]]:
    """The truth of a run: a head, and lists of objects and frames."""
    head: dict[str, Any] = {
        "note": SIMULATED.format(what=what).split("\n"),
        "conventions": {
            "world": "metres; floor plan x, y; z up; the floor is z = 0",
            "pose": "x, y (m), heading (rad) of the robot after the frame's step; a robot at "
            "heading h looks along (sin h, -cos h)",
            "tilt": "(p, q) rad: a point r of the robot frame is really at exp([p, q, 0]x) r in "
            "the level robot frame; the .cam file stays level",
            "disc": "robot_xy: true place in the level robot frame (m); pixel: of its centre; "
            "share: of its area in the image and not hidden; listed: has a row in map.circles",
            "edge": "alpha: true bearing (rad); ends: pixels u, v of top and bottom of the "
            "longest visible stretch; contrast: grey values right minus left; rows: how many "
            "image rows show it; listed: has a row in map.lines (it crosses the horizon, 12 px "
            "inside the image; 20 rows, a step of 12 grey values, a peak of the gradient within "
            "1 px)",
            "picture": "x0, y0, x1, y1, z0, z1 of posters: edges inside them are not listed",
        },
        "settings": {k: v for k, v in asdict(plan.settings).items() if k != "camera_text"},
        "disc_radius_m": DISC_RADIUS_M,
        "start": rounded(plan.poses[0], 9),
    }
    used = sorted({e.edge_id for t in truths for e in t.edges})
    lists: dict[str, list[Any]] = {
        "discs": [
            {"id": int(i), "xy": rounded(xy, 6)} for i, xy in zip(plan.disc_ids, plan.disc_xy)
        ],
        "lookalikes": [
            {"kind": kind, "xy": rounded([x, y], 6)} for kind, x, y in plan.lookalikes
        ],
        "pictures": [rounded(picture, 4) for picture in plan.pictures],
        "edges": [
            {"id": k, "xy": rounded([plan.edges[k].x, plan.edges[k].y], 6),
             "z": rounded([plan.edges[k].z0, plan.edges[k].z1], 4), "kind": plan.edges[k].label}
            for k in used
        ],
        "frames": [_frame_json(plan, truth) for truth in truths],
    }  # fmt: skip
    return head, lists


def _frame_json(plan: RunPlan, truth: FrameTruth) -> dict[str, Any]:
    frame = truth.frame
    return {
        "prefix": plan.prefix(frame),
        "pose": rounded(plan.poses[frame + 1], 9),
        "tilt": rounded(plan.tilts_rad[frame], 9),
        "wrong_odometry": bool(plan.wrong_odometry[frame]),
        "discs": [
            {"id": d.disc_id, "robot_xy": rounded(d.robot_xy, 6), "pixel": rounded(d.pixel, 3),
             "share": round(d.share, 3), "occluded": d.occluded, "cut": d.cut, "listed": d.listed}
            for d in truth.discs
        ],
        "edges": [
            {"id": e.edge_id, "alpha": round(e.bearing_rad, 6),
             "ends": rounded(e.ends.ravel(), 2), "contrast": round(e.contrast, 1),
             "rows": e.rows, "listed": e.listed}
            for e in truth.edges
        ],
    }  # fmt: skip
