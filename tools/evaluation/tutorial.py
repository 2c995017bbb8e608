"""The photographs of the tutorial: a checkerboard in the hand, and on the floor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from camera import read_camera
from camera.boards.board import Board
from redetect.storage import OutputExistsError
from tools.evaluation.boards import board_poses, rays_of, render_board

#: The board in the hand, and the one that lies on the floor: squares of 4 cm and 12 cm.
IN_HAND = Board("checkerboard", 9, 6, 0.04)
ON_FLOOR = Board("checkerboard", 9, 6, 0.12)
#: Where the middle of the latter lies: X (left) and Y (backward) of the robot, metres.
FLOOR_ORIGIN = (0.0, -1.3)


@dataclass(frozen=True)
class TutorialPhotographs:
    """Render the tutorial's photographs through the demo run's camera, so that truth is known."""

    output: Positional[Path]  # Folder for `boards/*.png` and `floor.png`.
    camera: Path = Path("images/e/e.cam")  # The camera that takes them.
    count: int = 14  # Photographs of the board in the hand.
    seed: int = 3  # Of the board's places, and the noise.

    def __call__(self) -> int:
        import cv2

        camera = read_camera(self.camera)
        boards = self.output / "boards"
        if boards.exists():
            raise OutputExistsError(boards)
        boards.mkdir(parents=True)
        rays = rays_of(camera, 3)
        poses = board_poses(camera, IN_HAND, self.count, self.seed, distances_m=(0.25, 0.5))
        for number, (rotation, translation) in enumerate(poses):
            image = render_board(rays, IN_HAND, rotation, translation, seed=self.seed + number)
            cv2.imwrite(str(boards / f"{number:02}.png"), image)
        # It lies like a page before somebody who looks ahead: x to the right, which is -X; z up.
        robot_from_board = np.diag([-1.0, -1.0, 1.0])
        robot_from_camera = np.asarray(camera.robot_from_camera)
        camera_from_robot = robot_from_camera[:, :3].T
        origin = np.array([*FLOOR_ORIGIN, 0.0]) - robot_from_camera[:, 3]
        image = render_board(
            rays, ON_FLOOR, camera_from_robot @ robot_from_board, camera_from_robot @ origin
        )
        cv2.imwrite(str(self.output / "floor.png"), image)
        print(f"{boards}: {self.count} photographs of a board")
        print(f"{self.output / 'floor.png'}: it lies {-FLOOR_ORIGIN[1]:g} m ahead")
        return 0
