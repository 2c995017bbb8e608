"""A simulated run's truth, and how far a map is from it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from redetect.slam.mapping.run_map import MappedRun
from redetect.slam.models.measurement import disc_in_robot
from redetect.slam.models.motion import relative_pose

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Truth:
    """Where everything really is, in the frame of the start.

    Attributes
    ----------
    poses : (N + 1, 3) float64
    discs, edges : dict of int to (2,) float64
    wrong_odometry : (N,) bool
        Steps whose odometry errs beyond its covariance.
    """

    poses: FloatArray
    discs: dict[int, FloatArray]
    edges: dict[int, FloatArray]
    wrong_odometry: BoolArray


@dataclass(frozen=True)
class Distance:
    """Distances from the truth.

    Attributes
    ----------
    path_rms_m, path_most_m : float
        Of positions along the path.
    discs_rms_m : float
    discs_nees : float
        Mean normalised error squared of a disc; 2 where the covariances are right.
    """

    path_rms_m: float
    path_most_m: float
    discs_rms_m: float
    discs_nees: float


def read_truth(run: Path) -> Truth:
    """Read a simulated run's ``truth.json``."""
    truth = json.loads((run / "truth.json").read_text(encoding="utf-8"))
    start = np.array(truth["start"])
    world = np.array([truth["start"], *(frame["pose"] for frame in truth["frames"])])
    poses = relative_pose(start, world)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return Truth(
        poses=poses,
        discs={d["id"]: disc_in_robot(start, d["xy"]) for d in truth["discs"]},
        edges={e["id"]: disc_in_robot(start, e["xy"]) for e in truth["edges"]},
        wrong_odometry=np.array([frame["wrong_odometry"] for frame in truth["frames"]]),
    )


def path_distance(poses: FloatArray, truth: Truth) -> tuple[float, float]:
    """Root mean square and largest distance of positions from the truth (m)."""
    off = np.linalg.norm((poses - truth.poses)[:, :2], axis=1)
    return float(np.sqrt(np.mean(off**2))), float(np.max(off))


def distance(mapped: MappedRun, truth: Truth) -> Distance:
    """Compare a map with the truth."""
    rms, most = path_distance(mapped.estimate.poses, truth)
    true = np.array([truth.discs[int(i)] for i in mapped.graph.disc_ids])
    off = mapped.estimate.disc_xy - true
    spread = np.linalg.inv(mapped.covariance.discs)
    return Distance(
        path_rms_m=rms,
        path_most_m=most,
        discs_rms_m=float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
        discs_nees=float(np.mean(np.einsum("ni,nij,nj->n", off, spread, off))),
    )
