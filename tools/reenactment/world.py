"""The world a recorded run happened in: where the robot drove, the discs lay and the camera looked.

A world is what `tools.reenactment.prepare` finds and what `tools.simulator.reenact` renders. Its
frames:

map
    the robot's frame before the first step.
robot
    X left, Y backward, Z up, origin on the floor; pose (x, y, theta) takes it to the map:
    ``p_map = [x, y] + Rot(theta) p_robot``.
camera
    ``robot_from_camera`` is the mounting that the camera really had, which need not be the one that
    its calibration file states.

In frame i the robot is tilted by pitch and roll ``tilt[i] = (p, q)``: the camera turns about its
own centre by the rotation vector (p, q, 0) of the robot frame, so that a pixel's direction is
``exp([p, q, 0]x) R d_camera`` while the centre stays. (A robot that tilts about a point on the
floor moves its camera as well, but by an amount that its pose takes up.)
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from redetect.storage import write_whole
from tools.arrays import FloatArray, IntArray


class WorldError(ValueError):
    """A file that should hold a world does not."""


class World(NamedTuple):
    """A path, the discs beside it and the camera that saw them."""

    prefixes: NDArray[np.str_]  # (N,) The prefix of each STEP's image.
    poses: FloatArray  # (N, 3) x, y (metres) and theta (radians) in the map after each STEP.
    tilt: FloatArray
    """(N, 2) Pitch and roll per frame: a rotation vector's x and y in the robot frame, radians."""
    disc_ids: IntArray
    """(M,) The discs' IDs, ascending; an ID that the recording gave to two discs occurs twice."""
    disc_xy: FloatArray  # (M, 2) The discs' centres in the map, metres.
    robot_from_camera: FloatArray
    """(3, 4) The true mounting: rotation and translation camera -> robot, metres."""


def write_world(path: Path, world: World, *, overwrite: bool = False) -> None:
    """Write a world as ``.npz``, one array per field of `World`; the same world, the same bytes."""
    with write_whole(path, overwrite=overwrite) as stream:
        np.savez_compressed(stream, **world._asdict())


def read_world(path: Path) -> World:
    """Read a world that `write_world` wrote."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return World(**{name: archive[name] for name in World._fields})
    except (KeyError, ValueError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        fields = ", ".join(World._fields)
        raise WorldError(f"{path}: {error}: expected a .npz with the arrays {fields}") from None
