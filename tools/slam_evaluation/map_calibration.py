"""Is the mounting that `slam map --calibrate` finds the true one? On simulated runs it is known.

Rows are written as a camera mounted otherwise than its calibration says would write them, with
errors drawn from their covariances; odometry's errors are as its covariances say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

from camera import Camera
from redetect.slam.commands.run_camera import camera_of_run
from redetect.slam.mapping.graph_terms import RowErrors, Weighting
from redetect.slam.mapping.run_map import map_run
from redetect.slam.models.measurement import disc_in_robot
from redetect.slam.models.mounted_discs import rotation_exp
from redetect.slam.models.mounting import rows_through_mounting
from redetect.slam.recording import Recording, read_recording
from tools.slam_evaluation.map_study import with_right_odometry
from tools.slam_evaluation.map_truth import Truth, path_distance, read_truth

FloatArray = NDArray[np.float64]

_WAYS: tuple[RowErrors, ...] = ("corrected", "recorded")


@dataclass(frozen=True)
class Settings:
    """Calibrate on simulated runs (python -m tools.simulator rows)."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run folders."""
    rotation_rad: tuple[float, float, float] = (-0.0366, 0.0099, 0.0024)
    """How the camera is turned against its calibration: about robot x, y, z."""
    height_m: float = -0.0111
    """How much higher it is."""
    seed: int = 1
    """Of all errors."""


def miswritten(
    recording: Recording, truth: Truth, camera: Camera, change: FloatArray, seed: int
) -> Recording:
    """A run whose rows come from a camera that is mounted otherwise than calibrated."""
    circles = recording.circles
    known = np.flatnonzero(circles.ids >= 0)
    places = np.array([truth.discs[int(i)] for i in circles.ids[known]])
    seen = disc_in_robot(truth.poses[circles.frame[known] + 1], places)
    # The way back: through the camera as mounted, read by the camera as calibrated.
    turn, _ = rotation_exp(-change[:3])
    mounted = camera.centre + np.array([0.0, 0.0, change[3]])
    rays = np.column_stack([seen, np.zeros(len(seen))]) - mounted
    nominal = np.column_stack([camera.rotation, camera.centre])
    written, _ = rows_through_mounting(camera, rays @ turn.T, nominal)
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(circles.covariance[known])
    errors = np.einsum("nij,nj->ni", root, rng.standard_normal((len(known), 2)))
    return replace(
        recording,
        circles=replace(
            circles,
            frame=circles.frame[known],
            xy=written + errors,
            covariance=circles.covariance[known],
            ids=circles.ids[known],
        ),
    )


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    settings = tyro.cli(Settings, prog="map-calibration", args=arguments)
    change = np.array([*settings.rotation_rad, settings.height_m])
    print(f"true: {' '.join(f'{value:8.4f}' for value in change)} (rad, rad, rad, m)")
    for run in settings.runs:
        truth, camera = read_truth(run), camera_of_run(run)
        right = with_right_odometry(read_recording(run), truth, settings.seed)
        written = miswritten(right, truth, camera, change, settings.seed)
        for way in _WAYS:
            mapped = map_run(written, camera, Weighting(calibrate=True, row_errors=way))
            assert mapped.mounting is not None
            sigma = np.sqrt(np.diag(mapped.mounting.covariance))
            off = (mapped.mounting.change - change) / sigma
            path, _ = path_distance(mapped.estimate.poses, truth)
            print(
                f"{run.name:<8}{way:<10} found {_row(mapped.mounting.change)}  sigma {_row(sigma)}"
                f"  off by {' '.join(f'{x:5.1f}' for x in off)} sigma"
                f"  factor {mapped.table.factor:.3f}  path {path:.2f} m",
                flush=True,
            )
    return 0


def _row(values: FloatArray) -> str:
    return " ".join(f"{value:8.4f}" for value in values)
