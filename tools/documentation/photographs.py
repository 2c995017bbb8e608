"""The photographs of the tutorial: a checkerboard before the demo run's camera, and on the floor.

    python -m tools.documentation.photographs mine

Rendered through `images/e/e.cam`, so that what the tutorial finds can be held against the truth.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tyro.conf import Positional

from camera import read_camera
from camera.boards.board import Board
from redetect.storage import OutputExistsError
from tools.camera_evaluation.rendering import board_poses, rays_of, render_board

#: The board in the hand, and the one that lies on the floor: squares of 4 cm and 12 cm.
IN_HAND = Board("checkerboard", 9, 6, 0.04)
ON_FLOOR = Board("checkerboard", 9, 6, 0.12)
#: Where the middle of the latter lies: X (left) and Y (backward) of the robot, metres.
FLOOR_ORIGIN = (0.0, -1.3)


@dataclass(frozen=True)
class Photographs:
    """Render the tutorial's photographs.

    Parameters
    ----------
    output : Path
        Folder for `boards/*.png` and `floor.png`.
    camera : Path
        The camera that takes them.
    count : int
        Photographs of the board in the hand.
    seed : int
        Of the board's places, and the noise.
    """

    output: Positional[Path]
    camera: Path = Path("images/e/e.cam")
    count: int = 14
    seed: int = 3


def render_photographs(options: Photographs) -> None:
    """Render them and write them.

    Raises
    ------
    OutputExistsError
        If the folder has photographs already.
    """
    import cv2

    camera = read_camera(options.camera)
    boards = options.output / "boards"
    if boards.exists():
        raise OutputExistsError(boards)
    boards.mkdir(parents=True)
    rays = rays_of(camera, 3)
    poses = board_poses(camera, IN_HAND, options.count, options.seed, distances_m=(0.25, 0.5))
    for number, (rotation, translation) in enumerate(poses):
        image = render_board(rays, IN_HAND, rotation, translation, seed=options.seed + number)
        cv2.imwrite(str(boards / f"{number:02}.png"), image)
    # It lies like a page before somebody who looks ahead: x to the right, which is -X; z up.
    robot_from_board = np.diag([-1.0, -1.0, 1.0])
    robot_from_camera = np.asarray(camera.robot_from_camera)
    camera_from_robot = robot_from_camera[:, :3].T
    origin = np.array([*FLOOR_ORIGIN, 0.0]) - robot_from_camera[:, 3]
    image = render_board(
        rays, ON_FLOOR, camera_from_robot @ robot_from_board, camera_from_robot @ origin
    )
    cv2.imwrite(str(options.output / "floor.png"), image)


def main() -> int:
    """Run the command line; returns the exit code."""
    options = tyro.cli(Photographs, description=__doc__)
    try:
        render_photographs(options)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{options.output / 'boards'}: {options.count} photographs of a board")
    print(f"{options.output / 'floor.png'}: it lies {-FLOOR_ORIGIN[1]:g} m ahead")
    return 0


if __name__ == "__main__":
    sys.exit(main())
