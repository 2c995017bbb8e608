"""The world a recorded run happened in: where the robot drove, the discs lay and the camera looked.

A world is what least squares finds (`tools.reenactment.refit`) and what a simulator renders. Its
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

import os
import zipfile
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.storage import write_whole
from tools.arrays import FloatArray, IntArray

# Zip entries carry a date; a constant one makes the same world the same bytes.
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)


class WorldError(ValueError):
    """A file that should hold a world does not."""


@dataclass(frozen=True, eq=False)
class World:
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

    def __post_init__(self) -> None:
        frames, discs = len(self.prefixes), len(self.disc_ids)
        for name, shape in (
            ("prefixes", (frames,)),
            ("poses", (frames, 3)),
            ("tilt", (frames, 2)),
            ("disc_ids", (discs,)),
            ("disc_xy", (discs, 2)),
            ("robot_from_camera", (3, 4)),
        ):
            found = np.shape(getattr(self, name))
            if found != shape:
                raise WorldError(f"{name} has shape {found}: expected {shape}")


_FIELDS = ("prefixes", "poses", "tilt", "disc_ids", "disc_xy", "robot_from_camera")


def write_world(path: str | os.PathLike[str], world: World, *, overwrite: bool = False) -> None:
    """Write a world as ``.npz``, one array per field of `World`; the same world, the same bytes."""
    with write_whole(path, overwrite=overwrite) as stream, zipfile.ZipFile(stream, "w") as archive:
        for name in _FIELDS:
            entry = zipfile.ZipInfo(f"{name}.npy", _ZIP_DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w") as member:
                np.lib.format.write_array(member, getattr(world, name), allow_pickle=False)


def read_world(path: str | os.PathLike[str]) -> World:
    """Read a world that `write_world` wrote."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return World(**{name: archive[name] for name in _FIELDS})
    except KeyError as error:
        raise WorldError(
            f"{path}: {error.args[0]}: expected the arrays {', '.join(_FIELDS)}"
        ) from None
    except (ValueError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise WorldError(f"{path}: not a world of arrays (.npz): {error}") from None
