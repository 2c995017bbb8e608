"""Poses from corners, without a start: the solvers of OpenCV and pycolmap behind one interface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pycolmap

from camera import Camera
from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.markers.chain import project_chain
from redetect.groundtruth.markers.refinement import PoseProblem
from redetect.groundtruth.markers.settings import Solver
from redetect.groundtruth.trajectories.transforms import apply, inverse, transform

SOLVERS: tuple[Solver, ...] = ("sqpnp", "epnp", "iterative", "ippe", "pycolmap")

_RANSAC_PX = 4.0


@dataclass(frozen=True, eq=False)
class PnpSolution:
    """A pose that explains the corners."""

    # (4, 4): `camera_from_object`, or `world_from_robot` where there are several cameras
    pose: FloatArray
    rms_px: float  # Root mean square of the residuals per coordinate, in the image as it is


def solve_camera(
    camera: Camera, points: FloatArray, pixels: FloatArray, solver: Solver = "sqpnp"
) -> list[PnpSolution]:
    """Pose of points seen by one camera.

    Parameters
    ----------
    points : (N, 3) array
        In the object's frame (m). For `ippe` they are the corners of one square marker in its own
        frame, as `redetect.groundtruth.markers.calibration.marker_corners` gives them.
    pixels : (N, 2) array
        In the original image; the lens' distortion is removed here.
    solver : str
        `sqpnp` (Terzakis & Lourakis 2020), `epnp` (Lepetit et al. 2009; of points in one plane it
        may give the mirror image), `iterative` (DLT or homography, then least squares), `ippe`
        (Collins & Bartoli 2014: both solutions that a square has), or `pycolmap` (RANSAC, then
        least squares).

    Returns
    -------
    list of PnpSolution
        The best first; two for `ippe` where the square has them.

    Raises
    ------
    GeometryError
        If there are fewer than 4 points, a pixel sees nothing through the lens, or no pose was
        found with all points in front of the camera.
    """
    if len(points) < 4:
        raise GeometryError(f"{len(points)} points: expected at least 4")
    normalised = camera.undistort(pixels)
    if not np.all(np.isfinite(normalised)):
        raise GeometryError("a corner lies where the lens sees nothing")
    if solver == "pycolmap":
        poses = _pycolmap(camera, points, normalised)
    else:
        poses = _opencv(points, normalised, solver)
    solutions = [PnpSolution(pose, _rms_px(camera, pose, points, pixels)) for pose in poses]
    solutions = [solution for solution in solutions if np.isfinite(solution.rms_px)]
    if not solutions:
        raise GeometryError(f"{solver} found no pose with all points in front of the camera")
    return sorted(solutions, key=lambda solution: solution.rms_px)


def solve_robot(problem: PoseProblem, solver: Solver = "sqpnp") -> list[PnpSolution]:
    """Pose of a robot seen by one or several cameras.

    `pycolmap` works on all cameras at once; the others on one camera, so there is a solution for
    each camera, and for `ippe` two for each marker in each image.

    `solver`: as in `solve_camera`. Returns `world_from_robot`, with residuals over all cameras; the
    best first. Solutions in which a corner is behind its camera are left out.
    """
    used = np.unique(problem.seen.camera)
    if solver == "pycolmap" and len(used) > 1:
        poses = _pycolmap_cameras(problem)
    elif solver == "ippe":
        poses = [pose for view in range(problem.views) for pose in view_poses(problem, view)]
    else:
        poses = []
        for index in used:
            chosen = problem.seen.camera == index
            points = apply(
                problem.robot_from_marker[problem.seen.part[chosen]], problem.seen.points[chosen]
            )
            try:
                found = solve_camera(
                    problem.cameras[index], points, problem.seen.pixels[chosen], solver
                )
            except GeometryError:
                continue
            poses += [problem.world_from_camera[index] @ solution.pose for solution in found]
    solutions = [PnpSolution(pose, robot_rms_px(problem, pose)) for pose in poses]
    solutions = [solution for solution in solutions if np.isfinite(solution.rms_px)]
    if not solutions:
        raise GeometryError(f"{solver} found no pose with all corners in front of their cameras")
    return sorted(solutions, key=lambda solution: solution.rms_px)


def view_poses(problem: PoseProblem, view: int) -> list[FloatArray]:
    """Poses `world_from_robot` that one marker in one image allows, the best first; may be none."""
    chosen = np.flatnonzero(problem.view == view)
    camera, marker = int(problem.seen.camera[chosen[0]]), int(problem.seen.part[chosen[0]])
    try:
        found = solve_camera(
            problem.cameras[camera],
            problem.seen.points[chosen],
            problem.seen.pixels[chosen],
            "ippe",
        )
    except GeometryError:
        return []
    marker_from_robot = inverse(problem.robot_from_marker[marker])
    return [
        problem.world_from_camera[camera] @ solution.pose @ marker_from_robot for solution in found
    ]


def robot_rms_px(problem: PoseProblem, world_from_robot: FloatArray) -> float:
    """Root mean square residual per coordinate; infinite with a corner behind its camera."""
    pixels = project_chain(
        problem.cameras,
        problem.world_from_camera,
        world_from_robot[None],
        problem.robot_from_marker,
        problem.seen,
    )
    return _root_mean_square(pixels - problem.seen.pixels)


def _rms_px(camera: Camera, pose: FloatArray, points: FloatArray, pixels: FloatArray) -> float:
    return _root_mean_square(camera.project(apply(pose, points)) - pixels)


def _root_mean_square(residuals: FloatArray) -> float:
    value = float(np.sqrt(np.mean(residuals**2)))
    return value if np.isfinite(value) else float("inf")


def _opencv(points: FloatArray, normalised: FloatArray, solver: Solver) -> list[FloatArray]:
    flags = {
        "sqpnp": cv2.SOLVEPNP_SQPNP,
        "epnp": cv2.SOLVEPNP_EPNP,
        "iterative": cv2.SOLVEPNP_ITERATIVE,
        "ippe": cv2.SOLVEPNP_IPPE_SQUARE,
    }
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            np.ascontiguousarray(points),
            np.ascontiguousarray(normalised),
            np.eye(3),
            None,
            flags=flags[solver],
        )
        poses = [
            transform(cv2.Rodrigues(rotation)[0], translation.ravel())
            for rotation, translation in zip(rotations, translations)
        ]
    except cv2.error as error:
        raise GeometryError(f"{solver} found no pose: {error.err}") from None
    return [pose for pose in poses if np.all(np.isfinite(pose))]


def _pycolmap(camera: Camera, points: FloatArray, normalised: FloatArray) -> list[FloatArray]:
    found = pycolmap.estimate_and_refine_absolute_pose(
        normalised * camera.scale_x,
        points,
        _pinhole(camera),
        estimation_options=pycolmap.AbsolutePoseEstimationOptions(ransac=_ransac()),
    )
    return [] if found is None else [_matrix(found["cam_from_world"])]


def _pycolmap_cameras(problem: PoseProblem) -> list[FloatArray]:
    points = apply(problem.robot_from_marker[problem.seen.part], problem.seen.points)
    used, index = np.unique(problem.seen.camera, return_inverse=True)
    pixels = np.empty_like(problem.seen.pixels)
    for camera in used:
        chosen = problem.seen.camera == camera
        lens = problem.cameras[camera]
        pixels[chosen] = lens.undistort(problem.seen.pixels[chosen]) * lens.scale_x
    if not np.all(np.isfinite(pixels)):
        raise GeometryError("a corner lies where the lens sees nothing")
    found = pycolmap.estimate_and_refine_generalized_absolute_pose(
        pixels,
        points,
        index.tolist(),
        [pycolmap.Rigid3d(inverse(problem.world_from_camera[c])[:3]) for c in used],
        [_pinhole(problem.cameras[camera]) for camera in used],
        estimation_options=_ransac(),
    )
    return [] if found is None else [_matrix(found["rig_from_world"])]


def _ransac() -> Any:
    # One thread and a seed: the same corners give the same pose.
    return pycolmap.RANSACOptions(
        max_error=_RANSAC_PX, min_num_trials=100, random_seed=0, num_threads=1
    )


def _pinhole(camera: Camera) -> Any:
    """A camera without distortion whose pixels are about those of `camera`."""
    return pycolmap.Camera(
        model="SIMPLE_PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[camera.scale_x, 0.0, 0.0],
    )


def _matrix(rigid: Any) -> FloatArray:
    matrix = np.asarray(rigid.matrix(), dtype=np.float64)
    return transform(matrix[:, :3], matrix[:, 3])
