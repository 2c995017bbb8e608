"""Discs of many sizes on floors with texture, seen by cameras of many kinds, with exact truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from camera import Camera
from detect.circles import detect_circles, vote_shape
from detect.settings import CircleSettings
from lut import build_vote_table
from lut.votes import radius_px
from tools.evaluation.disturbed import FloorScene, Tally, count_found, render_scene
from tools.evaluation.figures import Figures, Study
from tools.evaluation.tables import Table

_SIZES = (640, 480), (752, 480), (1280, 720)
#: Classes of the discs' radii in the image, pixels.
_CLASSES_PX = (0.0, 5.0, 10.0, 20.0, 40.0, math.inf)
#: Axes of a camera that looks ahead, in the robot frame.
_AHEAD = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])


def random_camera(rng: np.random.Generator) -> Camera:
    """A camera on a robot, of some size, width of view, distortion, height and pitch."""
    width, height = _SIZES[rng.integers(len(_SIZES))]
    half_width = math.tan(math.radians(rng.uniform(30.0, 50.0)))
    scale = width / (2.0 * half_width)
    down, aside = rng.uniform(15.0, 50.0), rng.normal(0.0, 2.0)
    pose = np.zeros((3, 4))
    pose[:, :3] = _AHEAD @ Rotation.from_euler("xz", [-down, aside], degrees=True).as_matrix()
    pose[2, 3] = rng.uniform(0.5, 1.8)
    centre = 0.5 * (width - 1.0), 0.5 * (height - 1.0)
    distortion = (-rng.uniform(0.0, 0.12) / (1.0 + half_width**2), 0.0, 0.0, 0.0, 0.0)
    return Camera(width, height, scale, scale, *centre, distortion, tuple(map(tuple, pose)))


@dataclass(frozen=True)
class Cameras(Study):
    """Detect discs on floors with texture, seen by random cameras: by their size in the image."""

    cameras: int = 24  # Cameras; each has its own radius of discs.
    scenes: int = 4  # Images of each camera, with up to four discs.
    seed: int = 1  # Of everything random.

    def measure(self) -> Figures:
        tallies = {low: Tally() for low in _CLASSES_PX[:-1]}
        every = Tally()
        for number in range(self.cameras):
            rng = np.random.default_rng([self.seed, number])
            camera = random_camera(rng)
            radius_m = float(np.clip(rng.uniform(0.06, 0.16) * camera.centre[2], 0.03, 0.2))
            settings = replace(CircleSettings(radius_m=radius_m), tilt_sigma_deg=0.0)
            scene = FloorScene(camera, radius_m, rng)
            votes = build_vote_table(camera, vote_shape(settings))
            for _ in range(self.scenes):
                image, places = render_scene(scene, "", 0.0, rng)
                found = detect_circles(image, camera, votes, settings)
                count_found(every, camera, found, places, radius_m)
                jacobians = camera.floor_jacobian(camera.project_floor(places))
                for place, size in zip(places, radius_px(radius_m, jacobians), strict=True):
                    tally = tallies[max(low for low in tallies if low <= size)]
                    count_found(tally, camera, found, [place], radius_m)
        table = Table(
            {"radius px": "<10", "shown": "d", "found": ".3f", "rms px": ".3f",
             "normalised": ".2f"}, keys=1
        )  # fmt: skip
        for (low, high), t in zip(pairwise(_CLASSES_PX), tallies.values(), strict=True):
            name = f"{low:.0f}-{high:.0f}" if high < math.inf else f"> {low:.0f}"
            table.row(name, t.shown, t.recall, t.rms_px, t.normalised_error)
        print(f"rows at no disc: {every.elsewhere}")
        return {**table.figures, "elsewhere": every.elsewhere}
