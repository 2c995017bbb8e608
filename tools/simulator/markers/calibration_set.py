"""Images from which a session's calibrations can be estimated.

``rig/``: the robot turns on the spot near each camera, which so sees several markers at a time.
``network/``: a double checkerboard, two boards fixed to each other, stands so that each of two
cameras sees one of them; and a board on the floor, seen by the first camera, defines the world.

Frames of boards are those of `camera.boards.board`, as of markers.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera.boards.board import Board
from redetect.array_types import FloatArray
from redetect.groundtruth.files import write_json
from redetect.groundtruth.markers.session import pose_entries
from redetect.groundtruth.trajectories.se3 import apply, inverse
from tools.simulator.driving import planar_transform
from tools.simulator.markers.room import facing_pose, lit
from tools.simulator.markers.session import (
    NOTE,
    SeenFrame,
    SessionPlan,
    SessionWriter,
    random_for,
    view_robot,
)
from tools.simulator.markers.surface import Surface
from tools.simulator.markers.things import checkerboard

_TURN_STEPS = 24
_PAUSE_S = 1.0
_RIG_S, _NETWORK_S = 100.0, 500.0
#: Placements of the double board before each pair of neighbouring cameras.
_PLACEMENTS = 10
_TRIES = 400
_EDGE_PX = 12.0


def board_surface(board: Board, pose: FloatArray) -> Surface:
    """A checkerboard with its white rim, one square wide."""
    texture = checkerboard(board.columns + 1, board.rows + 1)
    rows, columns = texture.values.shape
    return Surface(pose, columns * board.square_m, rows * board.square_m, texture, 0.3)


#: Both boards of the double board. Their numbers of corners are odd and even, so that a board
#: turned by half a turn looks different.
DOUBLE = Board("checkerboard", 7, 6, 0.11)
WORLD = Board("checkerboard", 9, 6, 0.15)
_BOARDS = {"first": DOUBLE, "second": DOUBLE, "world": WORLD}


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board in an image."""

    camera: int
    board: str
    placement: int  # Which placement of the double board; -1 for the board that defines the world.
    pose: FloatArray  # world_from_board.
    corners: FloatArray  # (N, 2) pixels of its inner corners.


def first_from_second(rng: np.random.Generator) -> FloatArray:
    """(4, 4) pose of the second board in the first one's frame: like two sides of a tent."""
    middle = np.array([0.35, 0.02, -0.45]) + rng.normal(0.0, 0.02, 3)
    second = facing_pose(
        np.zeros(3), np.radians(115.0) + rng.normal(0.0, 0.03), rng.normal(0.0, 0.03)
    )
    first = facing_pose(np.zeros(3), 0.0, 0.0)
    transform = inverse(first) @ second
    transform[:3, 3] = middle
    return np.asarray(transform)


def _world_view(plan: SessionPlan) -> BoardView:
    """The board on the floor as near to the first camera as it is seen whole."""
    middle = 0.5 * np.array(plan.settings.area_m)
    for share in np.arange(0.4, -0.6, -0.1):
        at = middle + share * (plan.network.world_from_camera[0, :2, 3] - middle)
        pose = planar_transform(float(at[0]), float(at[1]), 0.3)
        pose[2, 3] = 0.004
        view = _seen(plan, 0, "world", -1, pose)
        if view is not None:
            return view
    raise ValueError("no place on the floor where the first camera sees a board")


def board_views(plan: SessionPlan, offset: FloatArray) -> list[BoardView]:
    """Placements of the double board before neighbouring cameras, and the board of the world.
    `offset` (4, 4).
    """
    count = len(plan.network.names)
    pairs = [(c, (c + 1) % count) for c in range(count if count > 2 else count - 1)]
    views = []
    placement = 0
    for number, (one, other) in enumerate(pairs):
        rng = random_for(plan.settings.seed, "boards", number)
        found = 0
        for _ in range(_TRIES):
            seen = _placed(plan, offset, one, other, placement, rng)
            if seen is not None:
                views += seen
                found, placement = found + 1, placement + 1
            if found == _PLACEMENTS:
                break
        if found == 0:
            names = plan.network.names
            raise ValueError(f"no place where {names[one]} and {names[other]} see a board each")
    return [*views, _world_view(plan)]


def _placed(
    plan: SessionPlan,
    offset: FloatArray,
    one: int,
    other: int,
    placement: int,
    rng: np.random.Generator,
) -> list[BoardView] | None:
    """The double board somewhere in the area, turned between two cameras; None if not seen."""
    area = np.array(plan.settings.area_m)
    at = np.append(area * rng.uniform(0.1, 0.9, 2), rng.uniform(0.7, 1.3))
    toward = [plan.network.world_from_camera[c, :2, 3] - at[:2] for c in (one, other)]
    azimuths = [float(np.arctan2(d[1], d[0])) for d in toward]
    between = azimuths[0] + 0.5 * float(np.angle(np.exp(1j * (azimuths[1] - azimuths[0]))))
    # The second board looks some 115 degrees to the left of the first.
    azimuth = between + rng.normal(0.0, 0.15) - np.radians(57.5)
    first = facing_pose(at, azimuth, rng.uniform(0.1, 0.5), rng.normal(0.0, 0.1))
    # Whichever of the cameras is on the right sees the first board.
    for right, left in ((one, other), (other, one)):
        views = (
            _seen(plan, right, "first", placement, first),
            _seen(plan, left, "second", placement, first @ offset),
        )
        if views[0] is not None and views[1] is not None:
            return [views[0], views[1]]
    return None


def _seen(
    plan: SessionPlan, camera: int, board: str, placement: int, pose: FloatArray
) -> BoardView | None:
    """The board in the image, if all of it is in view and not too slanted."""
    model, kind = plan.network.cameras[camera], _BOARDS[board]
    to_camera = plan.camera_from_world[camera] @ pose
    middle = to_camera[:3, 3]
    if -(to_camera[:3, 2] @ middle) < 0.5 * np.linalg.norm(middle):
        return None
    outline = model.project(board_surface(kind, to_camera).corners())
    size = np.array([model.width, model.height])
    if not np.all((outline > _EDGE_PX) & (outline < size - 1.0 - _EDGE_PX)):
        return None
    return BoardView(camera, board, placement, pose, model.project(apply(to_camera, kind.points)))


def write_calibration_set(plan: SessionPlan, folder: Path, writer: SessionWriter) -> int:
    """Write ``rig/`` and ``network/`` below a folder; returns the number of images."""
    count = _write_rig_images(plan, folder / "rig", writer)
    return count + _write_network_images(plan, folder / "network", writer)


def turning_poses(plan: SessionPlan, camera: int) -> FloatArray:
    """(24, 3) poses of the robot as it turns on the spot where a camera sees it well and near."""
    model, area = plan.network.cameras[camera], np.array(plan.settings.area_m)
    start = plan.network.world_from_camera[camera, :2, 3]
    ticks = np.linspace(0.0, 1.0, 41)[:, None]
    places = start + ticks * (area / 2.0 - start)
    # The robot with its boards fits into a cylinder.
    a = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    rim = np.concatenate(
        [np.column_stack([0.6 * np.cos(a), 0.6 * np.sin(a), np.full(12, z)]) for z in (0.0, 0.8)]
    )
    # (41, 24, 2) pixels; if it is seen whole nowhere, it turns in the middle of the area.
    rims = rim + np.insert(places, 2, 0.0, axis=1)[:, None]
    pixels = model.project(apply(plan.camera_from_world[camera], rims))
    size = np.array([model.width, model.height])
    whole = np.all((pixels > 0.0) & (pixels < size - 1.0), axis=(1, 2))
    nearest = places[np.argmax(whole)] if whole.any() else area / 2.0
    turn = np.linspace(-np.pi, np.pi, _TURN_STEPS, endpoint=False) + 0.07 * camera
    return np.column_stack([np.tile(nearest, (_TURN_STEPS, 1)), turn])


def _write_rig_images(plan: SessionPlan, folder: Path, writer: SessionWriter) -> int:
    writer.calibrations(plan, folder)
    seen: list[SeenFrame] = []
    poses: list[FloatArray] = []
    for camera, name in enumerate(plan.network.names):
        for pose in turning_poses(plan, camera):
            number = len(seen)
            view = view_robot(plan, camera, pose, np.zeros(3), 1_000_000 + number)
            prefix = f"rig.{number:04d}"
            writer.image(folder, name, prefix, view.image)
            poses.append(pose)
            seen.append(SeenFrame(name, prefix, _RIG_S + _PAUSE_S * number, view.markers))
    writer.times(folder, plan, seen)
    times_s = np.array([s.time_s for s in seen])
    writer.poses(folder / "truth.csv", times_s, np.stack(poses))
    writer.truth(folder / "truth.json", plan, seen)
    return len(seen)


def _write_network_images(plan: SessionPlan, folder: Path, writer: SessionWriter) -> int:
    writer.calibrations(plan, folder)
    offset = first_from_second(random_for(plan.settings.seed, "boards", 99))
    views = board_views(plan, offset)
    after = max(view.placement for view in views) + 1
    rows, truth = [], []
    seen: list[SeenFrame] = []
    for number, view in enumerate(views):
        if view.board == "world":
            boards = [board_surface(WORLD, view.pose)]
        else:
            first = view.pose if view.board == "first" else view.pose @ inverse(offset)
            boards = [board_surface(DOUBLE, at) for at in (first, first @ offset)]
        name = plan.network.names[view.camera]
        place = view.placement if view.placement >= 0 else after
        prefix = f"network.{place:04d}"
        in_view = [lit(b).moved(plan.camera_from_world[view.camera]) for b in boards]
        background = plan.background(view.camera)
        grey = plan.image(view.camera, [in_view], background, 2_000_000 + number)
        image = writer.image(folder, name, prefix, grey)
        seen.append(SeenFrame(name, prefix, _NETWORK_S + _PAUSE_S * place, ()))
        rows.append({"camera": name, "image": image, "placement": place, "board": view.board})
        truth.append(
            {"image": image, "board": view.board, "world_from_board": pose_entries(view.pose),
             "corners": np.round(view.corners, 4).tolist()}
        )  # fmt: skip
    writer.times(folder, plan, seen)
    content: dict[str, Any] = {
        "note": NOTE,
        "boards": {
            name: {"columns": board.columns, "rows": board.rows, "square_m": board.square_m}
            for name, board in _BOARDS.items()
        },
        "first_from_second": pose_entries(offset),
        "world_from_board": pose_entries(_world_view(plan).pose),
        "images": rows,
    }
    write_json(folder / "boards.json", content, overwrite=writer.overwrite)
    writer.truth(folder / "truth.json", plan, (), extra={"boards": truth})
    return len(views)
