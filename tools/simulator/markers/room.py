"""A room with cameras under its ceiling, and a box-shaped robot with six markers.

World frame: the robot's area spans x from 0 and y from 0, z is up, the floor is z = 0; metres.
Robot frame: origin on the floor below its middle, x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from camera import Camera
from camera.uncertainty import IDENTITY
from detect.markers.dictionaries import MarkerDictionary, marker_dictionary
from redetect.array_types import FloatArray
from redetect.groundtruth.markers.session import Rig
from redetect.groundtruth.trajectories import se3
from tools.simulator.driving import planar_transform
from tools.simulator.markers.surface import (
    Surface,
    Texture,
    box_against,
    box_sides,
    marker_surface,
    plain,
    pose_of,
)
from tools.simulator.markers.things import blotches, near_marker, thing

#: Identifiers of the markers on the robot.
ROBOT_IDS = (31, 64, 107, 200, 333, 498)

# Where each board has its middle (m), and where it looks: azimuth from x, elevation, turn (deg).
_BOARDS = (
    ((0.43, 0.0, 0.42), (0.0, 25.0, 0.0)),
    ((0.0, 0.32, 0.42), (90.0, 22.0, 0.0)),
    ((-0.43, 0.0, 0.42), (180.0, 25.0, 0.0)),
    ((0.0, -0.32, 0.42), (-90.0, 22.0, 0.0)),
    ((0.18, 0.02, 0.68), (12.0, 58.0, 20.0)),
    ((-0.18, -0.02, 0.68), (168.0, 58.0, -15.0)),
)
_BODY_M = (0.72, 0.5, 0.45)
_GROUND_M = 0.1
_QUIET_CELLS = 2
_ANGLE_SIGMA_DEG = 2.0
_PLACE_SIGMA_M = 0.004
#: Half of the robot's extent on the floor, its boards included.
FOOTPRINT_M = (0.5, 0.4)


def robot_rig(rng: np.random.Generator, dictionary: str = "rawseeds", width_m: float = 0.2) -> Rig:
    """Six markers on a robot, their boards mounted by hand: a few millimetres and degrees off."""
    known = marker_dictionary(dictionary)
    ids = ROBOT_IDS if ROBOT_IDS[-1] < len(known) else tuple(range(len(_BOARDS)))
    poses = []
    for place, angles in _BOARDS:
        azimuth, elevation, turn = np.radians(
            np.array(angles) + rng.normal(0.0, _ANGLE_SIGMA_DEG, 3)
        )
        middle = np.array(place) + rng.normal(0.0, _PLACE_SIGMA_M, 3)
        poses.append(facing_pose(middle, azimuth, elevation, turn))
    count = len(poses)
    return Rig(
        dictionary, ids, np.full(count, width_m), np.stack(poses), np.zeros((6 * count, 6 * count))
    )


def facing_pose(
    middle: FloatArray, azimuth_rad: float, elevation_rad: float, turn_rad: float = 0.0
) -> FloatArray:
    """parent_from_surface of an upright surface whose normal has an azimuth and an elevation.
    `middle` (3,).
    """
    ca, sa = np.cos(azimuth_rad), np.sin(azimuth_rad)
    ce, se = np.cos(elevation_rad), np.sin(elevation_rad)
    right, up = np.array([-sa, ca, 0.0]), np.array([-se * ca, -se * sa, ce])
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return pose_of(c * right + s * up, c * up - s * right, middle)


def robot_surfaces(rig: Rig, rng: np.random.Generator) -> list[Surface]:
    """All that is seen of the robot, in its own frame: first its boards in the rig's order."""
    known = marker_dictionary(rig.dictionary)
    boards = [
        marker_surface(known, marker, float(width), pose, _QUIET_CELLS)
        for marker, width, pose in zip(rig.ids, rig.widths_m, rig.robot_from_marker)
    ]
    lifted = se3.transform(np.eye(3), [0.0, 0.0, _GROUND_M])
    paint = {side: _panel(rng) for side in ("front", "rear", "left", "right")}
    body = box_sides(_BODY_M, {**paint, "top": plain(0.3)}, lifted)
    wheels = [
        surface
        for x in (-0.22, 0.22)
        for surface in box_sides(
            (0.16, _BODY_M[1] - 0.04, _GROUND_M),
            {side: plain(0.06) for side in ("front", "rear", "left", "right")},
            planar_transform(x, 0.0, 0.0),
        )
    ]
    return [*boards, *body, *wheels]


def _panel(rng: np.random.Generator) -> Texture:
    """A painted side with vents and a label."""
    values = 0.34 + 0.05 * (blotches(rng, (90, 144)) - np.float32(0.5))
    for row in range(52, 82, 6):
        values[row : row + 3, 20:90] = 0.08
    values[20:34, 100:132] = 0.7
    values[24:30, 104:122] = 0.2
    values[:4], values[-4:] = 0.15, 0.15
    return Texture(np.asarray(values, dtype=np.float32), smooth=True)


CAMERA_NAMES = "abcd"

_MARGIN_M = 1.6
_HEIGHT_M = 3.2
_COEF = (0.0, -0.13, 0.0, 0.12, 0.0)
# The corners of the room from which cameras look, in margins beyond the area, and heights (m).
_CORNERS = ((0, 0, 2.9), (1, 0, 2.75), (1, 1, 3.0), (0, 1, 2.85))
_SUN = np.array([0.75, -0.35, 0.56])


def room_cameras(
    rng: np.random.Generator, count: int, area_m: tuple[float, float], width: int, height: int
) -> tuple[tuple[Camera, ...], FloatArray]:
    """Cameras in the corners of the room.
    `area_m` (2,); returns `world_from_camera` (count, 4, 4).
    """
    area = np.array(area_m)
    cameras, poses = [], []
    for cx, cy, z in _CORNERS[:count]:
        corner = np.array([cx, cy])
        at = corner * area + (2 * corner - 1) * (_MARGIN_M - 0.25) + rng.normal(0.0, 0.1, 2)
        target = np.append(area / 2.0 + rng.normal(0.0, 0.15, 2), 0.15)
        position = np.append(at, z + rng.normal(0.0, 0.05))
        poses.append(looking_at(position, target, float(rng.normal(0.0, 0.03))))
        focal = width * rng.uniform(0.86, 0.9)
        centre = 0.5 * (np.array([width, height]) - 1.0) + rng.normal(0.0, 0.006 * width, 2)
        cameras.append(
            Camera(width, height, focal, focal * rng.uniform(0.998, 1.002), float(centre[0]),
                   float(centre[1]), _COEF, IDENTITY)
        )  # fmt: skip
    return tuple(cameras), np.stack(poses)


def looking_at(position: FloatArray, target: FloatArray, roll_rad: float = 0.0) -> FloatArray:
    """world_from_camera of a camera that looks at a point, almost upright."""
    forward = target - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    rotation = np.column_stack([c * right + s * down, c * down - s * right, forward])
    return se3.transform(rotation, position)


def room_surfaces(
    rng: np.random.Generator, area_m: tuple[float, float], dictionary: str
) -> list[Surface]:
    """Floor, walls, what hangs on them and stands before them, in the world frame.

    None of it is ever between a camera and the robot.

    `area_m` (2,).
    """
    known = marker_dictionary(dictionary)
    low = np.full(2, -_MARGIN_M)
    high = np.array(area_m) + _MARGIN_M
    middle, size = 0.5 * (low + high), high - low
    floor = pose_of([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [*middle, 0.0])
    surfaces = [Surface(floor, size[0], size[1], _floor(rng, size))]
    for azimuth in (0.0, 90.0, 180.0, -90.0):
        # The wall from which one looks along the azimuth.
        a = np.radians(azimuth)
        normal = np.array([np.cos(a), np.sin(a)])
        across = float(abs(normal[1]) * size[0] + abs(normal[0]) * size[1])
        foot = middle - normal * 0.5 * float(np.abs(normal) @ size)
        wall = facing_pose(np.append(foot, 0.5 * _HEIGHT_M), a, 0.0)
        paint = 0.62 + 0.12 * (blotches(rng, (64, 192)) - np.float32(0.5))
        paint[-3:] = 0.2
        surfaces.append(Surface(wall, across, _HEIGHT_M, Texture(paint, smooth=True)))
        surfaces += _on_the_wall(rng, wall, across, known)
        surfaces += _before_the_wall(rng, wall, across, known)
    return surfaces


def obstacles(rng: np.random.Generator, area_m: tuple[float, float]) -> list[Surface]:
    """Things beside the area that hide the robot from a camera now and then, world frame."""
    width, depth = area_m
    result = []
    for x, y, size in (
        (0.35 * width, -0.65, (0.09, 0.09, 1.7)),
        (width + 0.65, 0.6 * depth, (0.4, 0.45, 0.9)),
        (0.15 * width, depth + 0.65, (0.5, 0.3, 0.75)),
    ):
        shade = rng.uniform(0.1, 0.7)
        factors = {"front": 1.0, "rear": 0.8, "left": 0.9, "right": 0.7, "top": 1.1}
        textures = {side: plain(float(shade * factor)) for side, factor in factors.items()}
        turn = rng.uniform(0.0, np.pi)
        result += box_sides(size, textures, planar_transform(x, y, turn))
    return result


def lit(surface: Surface) -> Surface:
    """A surface of the world in the room's light: brightest from above and from the windows."""
    normal = surface.pose[:3, 2]
    factor = 0.6 + 0.25 * max(float(normal[2]), 0.0) + 0.2 * max(float(normal @ _SUN), 0.0)
    texture = replace(surface.texture, values=surface.texture.values * np.float32(factor))
    return replace(surface, texture=texture, back=surface.back * 0.8)


def _floor(rng: np.random.Generator, size: FloatArray) -> Texture:
    """Tiles of half a metre, worn and stained."""
    per_m = 100
    columns, rows = (size * per_m).astype(int)
    values = 0.42 + 0.10 * (blotches(rng, (rows, columns), octaves=6) - np.float32(0.5))
    values += (0.012 * rng.standard_normal((rows, columns))).astype(np.float32)
    tile = per_m // 2
    for r in range(0, rows, tile):
        for c in range(0, columns, tile):
            values[r : r + tile, c : c + tile] += np.float32(rng.normal(0.0, 0.02))
    values[::tile], values[:, ::tile] = 0.25, 0.25
    return Texture(np.asarray(values, dtype=np.float32), smooth=True)


def _on_the_wall(
    rng: np.random.Generator, wall: FloatArray, across: float, known: MarkerDictionary
) -> list[Surface]:
    result = []
    x = -0.5 * across + 0.4
    while x < 0.5 * across - 0.6:
        if rng.random() < 0.3:
            texture = near_marker(rng, known)
        else:
            _, texture = thing(rng, known)
        rows, columns = texture.values.shape
        width = rng.uniform(0.25, 1.1)
        height = width * rows / columns
        if height > 1.5:
            width, height = 1.5 * width / height, 1.5
        local = np.eye(4)
        local[:3, 3] = [x + 0.5 * width, rng.uniform(-0.7, 0.5), 0.01]
        result.append(Surface(wall @ local, width, height, texture))
        x += width + rng.uniform(0.15, 0.7)
    return result


def _before_the_wall(
    rng: np.random.Generator, wall: FloatArray, across: float, known: MarkerDictionary
) -> list[Surface]:
    """Cupboards, boxes and shelves."""
    result: list[Surface] = []
    x = -0.5 * across + rng.uniform(0.2, 0.8)
    while x < 0.5 * across - 0.8:
        size = np.array([rng.uniform(0.25, 0.5), rng.uniform(0.3, 1.0), rng.uniform(0.3, 1.3)])
        shade = rng.uniform(0.1, 0.75)
        textures = {
            side: plain(float(shade * rng.uniform(0.85, 1.1)))
            for side in ("front", "left", "right", "top")
        }
        if rng.random() < 0.5:
            _, textures["front"] = thing(rng, known)
        foot = x + 0.5 * size[1], -0.5 * _HEIGHT_M, 0.5 * size[0] + 0.02
        result += box_sides(size, textures, wall @ box_against(foot))
        x += size[1] + rng.uniform(0.3, 1.8)
    return result
