"""The robot's pose at one time: solutions, wrong markers, and the planar ambiguity.

The chosen solver (of OpenCV or pycolmap) gives initial poses, which are refined by least squares
over all corners. If all markers agree, their mirror image is tested, which may explain the corners,
too. If not, the hypothesis of a single marker with which most others agree determines the wrong
ones.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np

from camera import Camera
from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.markers import refinement
from redetect.groundtruth.settings import PoseSettings, Solver
from redetect.groundtruth.trajectories import se3

_RANSAC_PX = 4.0
# Two minima closer than this are one; mirror images are tens of degrees apart, or are no problem.
_SAME_ANGLE_RAD = 0.01
_SAME_PLACE_M = 0.005
# A mirror image that explains all views is close to the estimate from one view alone.
_FARTHEST_START_PX = 40.0
# Number of poses by single views from which all views are fitted.
_OWN_STARTS = 4
# A robot farther than this from all cameras is not a solution: least squares diverged.
_FARTHEST_M = 1e4


def solve_camera(
    camera: Camera, points: FloatArray, pixels: FloatArray, solver: str = "sqpnp"
) -> list[FloatArray]:
    """Pose of points seen by one camera.

    Parameters
    ----------
    points : (N, 3) array
        In the object's frame (m). For `ippe` they are the corners of one square marker in its own
        frame, as `redetect.groundtruth.markers.session.marker_corners` gives them.
    pixels : (N, 2) array
        In the original image; the lens' distortion is removed here.
    solver : str
        `sqpnp` (Terzakis & Lourakis 2020), `epnp` (Lepetit et al. 2009; of points in one plane it
        may give the mirror image), `iterative` (DLT or homography, then least squares), `ippe`
        (Collins & Bartoli 2014: both solutions that a square has).

    Returns
    -------
    list of (4, 4) arrays
        `camera_from_object`, the best first; two for `ippe` where the square has them.

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
    found = _best_first(
        _opencv(points, normalised, solver),
        lambda pose: _rms(camera.project(se3.apply(pose, points)) - pixels),
    )
    if not found:
        raise GeometryError(f"{solver} found no pose with all points in front of the camera")
    return found


def solve_robot(problem: refinement.PoseProblem, solver: Solver = "sqpnp") -> list[FloatArray]:
    """Pose of a robot seen by one or several cameras.

    `pycolmap` (RANSAC, then least squares) works on all cameras at once; the others on one camera,
    so there is a solution for each camera, and for `ippe` two for each marker in each image.

    `solver`: else as in `solve_camera`. Returns `world_from_robot`, those with the least residuals
    over all cameras first. Solutions in which a corner is behind its camera are left out: there may
    be none.
    """
    if solver == "pycolmap":
        poses = _pycolmap(problem)
    elif solver == "ippe":
        poses = [pose for view in range(problem.views) for pose in view_poses(problem, view)]
    else:
        poses = []
        for index in np.unique(problem.seen.camera):
            chosen = problem.seen.camera == index
            lens, pixels = problem.network.cameras[index], problem.seen.pixels[chosen]
            with suppress(GeometryError):
                found = solve_camera(lens, problem.robot_points[chosen], pixels, solver)
                poses += [problem.network.world_from_camera[index] @ pose for pose in found]
    return _best_first(poses, lambda pose: robot_rms_px(problem, pose))


def _best_first(poses: list[FloatArray], rms_px: Callable[[FloatArray], float]) -> list[FloatArray]:
    """The poses with finite residuals, the least first."""
    scored = [(rms_px(pose), pose) for pose in poses]
    finite = [entry for entry in scored if np.isfinite(entry[0])]
    return [pose for _, pose in sorted(finite, key=lambda entry: entry[0])]


def view_poses(problem: refinement.PoseProblem, view: int) -> list[FloatArray]:
    """Poses `world_from_robot` that one marker in one image allows, the best first; may be none."""
    chosen = np.flatnonzero(problem.view == view)
    camera, marker = int(problem.seen.camera[chosen[0]]), int(problem.seen.part[chosen[0]])
    points, pixels = problem.seen.points[chosen], problem.seen.pixels[chosen]
    try:
        found = solve_camera(problem.network.cameras[camera], points, pixels, "ippe")
    except GeometryError:
        return []
    marker_from_robot = se3.inverse(problem.rig.robot_from_marker[marker])
    return [problem.network.world_from_camera[camera] @ pose @ marker_from_robot for pose in found]


def robot_rms_px(problem: refinement.PoseProblem, world_from_robot: FloatArray) -> float:
    """Root mean square residual per coordinate; infinite with a corner behind its camera."""
    return _rms(problem.pixels(world_from_robot) - problem.seen.pixels)


def _rms(residuals: FloatArray) -> float:
    value = float(np.sqrt(np.mean(residuals**2)))
    return value if np.isfinite(value) else float("inf")


def _opencv(points: FloatArray, normalised: FloatArray, solver: str) -> list[FloatArray]:
    flags = {
        "sqpnp": cv2.SOLVEPNP_SQPNP,
        "epnp": cv2.SOLVEPNP_EPNP,
        "iterative": cv2.SOLVEPNP_ITERATIVE,
        "ippe": cv2.SOLVEPNP_IPPE_SQUARE,
    }
    both = (np.ascontiguousarray(points), np.ascontiguousarray(normalised))
    try:
        found = cv2.solvePnPGeneric(*both, np.eye(3), None, flags=flags[solver])
        poses = [se3.transform(cv2.Rodrigues(r)[0], t.ravel()) for r, t in zip(*found[1:3])]
    except cv2.error as error:
        raise GeometryError(f"{solver} found no pose: {error.err}") from None
    return [pose for pose in poses if np.all(np.isfinite(pose))]


def _pycolmap(problem: refinement.PoseProblem) -> list[FloatArray]:
    import pycolmap  # not every platform has it

    used, index = np.unique(problem.seen.camera, return_inverse=True)
    lenses = [problem.network.cameras[camera] for camera in used]
    pixels = np.empty_like(problem.seen.pixels)
    for lens, camera in zip(lenses, used):
        chosen = problem.seen.camera == camera
        pixels[chosen] = lens.undistort(problem.seen.pixels[chosen]) * lens.scale_x
    if not np.all(np.isfinite(pixels)):
        return []
    # Cameras without distortion whose pixels are about those of the images.
    kind = "SIMPLE_PINHOLE"
    pinholes = [
        pycolmap.Camera(model=kind, width=c.width, height=c.height, params=[c.scale_x, 0.0, 0.0])
        for c in lenses
    ]
    found = pycolmap.estimate_and_refine_generalized_absolute_pose(
        pixels,
        problem.robot_points,
        index.tolist(),
        [pycolmap.Rigid3d(se3.inverse(problem.network.world_from_camera[c])[:3]) for c in used],
        pinholes,
        # One thread and a seed: the same corners give the same pose.
        estimation_options=pycolmap.RANSACOptions(
            max_error=_RANSAC_PX, min_num_trials=100, random_seed=0, num_threads=1
        ),
    )
    if found is None:
        return []
    matrix = np.asarray(found["rig_from_world"].matrix(), dtype=np.float64)
    return [se3.transform(matrix[:, :3], matrix[:, 3])]


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Pose estimate from the corners of one time."""

    candidates: tuple[refinement.RefinedPose, ...]  # The best first; several if ambiguous
    views: BoolArray  # (V,): which of all views they explain
    log_odds: tuple[float, ...]  # Of the first against each candidate: 0 for the first

    @property
    def ambiguous(self) -> bool:
        """Whether there is more than one candidate."""
        return len(self.candidates) > 1


def estimate_pose(problem: refinement.PoseProblem) -> PoseEstimate:
    """All poses of a robot that its markers' corners allow.

    Raises `GeometryError` if no pose explains a view, or poses that exclude each other do as well.
    """
    if problem.views == 0:
        raise GeometryError("no marker of the rig was seen")
    settings = problem.settings
    starts = solve_robot(problem, settings.solver)
    found = _distinct(problem, refinement.refined_poses(problem, starts[:1]))
    # Least squares may not have reached the right minimum from the solver's start.
    if not found or np.any(_disagreeing(found[0], settings)):
        starts += solve_robot(problem, "ippe")[:_OWN_STARTS]
        found = _distinct(problem, refinement.refined_poses(problem, starts))
    if found and not np.any(_disagreeing(found[0], settings)):
        views = np.ones(problem.views, dtype=np.bool_)
    else:
        views, refined = _consensus(problem)
        found = [refined]
    alone = problem.only(views)
    starts = solve_robot(alone, settings.solver)[:1] + _mirrored(alone)
    minima = _distinct(problem, found + refinement.refined_poses(alone, starts))
    if not minima:
        raise GeometryError(f"no pose within {_FARTHEST_M:g} m of a camera explains the markers")
    best = minima[0]
    # Squared residuals may be larger than their covariances imply.
    inflation = max(1.0, best.cost / max(1, best.degrees_of_freedom))
    limit = best.cost + 2.0 * np.log(settings.ambiguity_odds) * inflation
    # The best minimum and those that it cannot exclude.
    rivals = (p for p in minima[1:] if p.cost <= limit and not _within_covariance(p, best))
    candidates = (best, *rivals)
    log_odds = tuple(0.5 * (c.cost - best.cost) / inflation for c in candidates)
    return PoseEstimate(candidates, views, log_odds)


def _disagreeing(refined: refinement.RefinedPose, settings: PoseSettings) -> BoolArray:
    far = refined.view_errors > settings.outlier_sigma
    return np.asarray(far & (refined.view_rms_px > settings.outlier_px))


def _mirrored(problem: refinement.PoseProblem) -> list[FloatArray]:
    """Both solutions of each camera's largest view: starts from which a mirror image is found."""
    largest = [
        int(max(np.unique(problem.view[problem.seen.camera == camera]), key=problem.extent_px))
        for camera in np.unique(problem.seen.camera)
    ]
    poses = [pose for view in largest for pose in view_poses(problem, view)]
    return [pose for pose in poses if robot_rms_px(problem, pose) < _FARTHEST_START_PX]


def _distinct(
    problem: refinement.PoseProblem, minima: list[refinement.RefinedPose]
) -> list[refinement.RefinedPose]:
    """Those near a camera that differ, the best first."""
    cameras = problem.network.world_from_camera[:, :3, 3]
    kept: list[refinement.RefinedPose] = []
    for pose in sorted(minima, key=lambda pose: pose.cost):
        far_m = np.linalg.norm(cameras - pose.world_from_robot[:3, 3], axis=1).min()
        if far_m < _FARTHEST_M and not any(_same(pose, other) for other in kept):
            kept.append(pose)
    return kept


def _same(a: refinement.RefinedPose, b: refinement.RefinedPose) -> bool:
    apart = se3.inverse(a.world_from_robot) @ b.world_from_robot
    turn = np.linalg.norm(se3.log(apart)[3:])
    return bool(np.linalg.norm(apart[:3, 3]) < _SAME_PLACE_M and turn < _SAME_ANGLE_RAD)


def _within_covariance(pose: refinement.RefinedPose, best: refinement.RefinedPose) -> bool:
    """Whether a second minimum is within the covariance of the best one."""
    apart = se3.log(se3.inverse(best.world_from_robot) @ pose.world_from_robot)
    return bool(apart @ np.linalg.solve(best.covariance, apart) < 4.0)


def _consensus(problem: refinement.PoseProblem) -> tuple[BoolArray, refinement.RefinedPose]:
    """The largest set of views that agree, and their pose."""
    count = problem.views
    found: dict[bytes, tuple[BoolArray, refinement.RefinedPose]] = {}
    # A larger marker is the better hypothesis.
    order = np.argsort([problem.extent_px(view) for view in range(count)])[::-1]
    hypotheses = ((view, start) for view in order for start in view_poses(problem, view))
    for view, start in hypotheses:
        explained = _explained(problem, np.arange(count) == view, start)
        if explained is None:
            continue
        views, refined = explained
        other = found.get(views.tobytes())
        if other is None or refined.cost < other[1].cost:
            found[views.tobytes()] = explained
        if 3 * int(views.sum()) > 2 * count:  # no other candidate can have as many
            break
    if not found:
        raise GeometryError("no pose explains any of the markers")
    largest = max(int(views.sum()) for views, _ in found.values())
    best = [entry for entry in found.values() if int(entry[0].sum()) == largest]
    best.sort(key=lambda entry: entry[1].cost)
    # Sets that share most of their views differ only in a doubtful view.
    if any(2 * int((views & best[0][0]).sum()) <= largest for views, _ in best):
        raise GeometryError(f"groups of {largest} markers exclude each other")
    return best[0]


def _explained(
    problem: refinement.PoseProblem, views: BoolArray, start: FloatArray
) -> tuple[BoolArray, refinement.RefinedPose] | None:
    """Views that agree with a hypothesis, grown and pruned until they stay; None if none does."""
    pose = start
    for _ in range(6):
        try:
            refined = refinement.refine_pose(problem.only(views), pose)
        except GeometryError:
            return None
        pose = refined.world_from_robot
        if np.any(_disagreeing(refined, problem.settings)):
            if views.sum() == 1:
                return None
            worst = np.flatnonzero(views)[int(np.argmax(refined.view_errors))]
            views = views & (np.arange(len(views)) != worst)
            continue
        predicted = refinement.predicted_errors(problem, pose, refined.covariance)
        grown = views | (predicted < problem.settings.outlier_sigma)
        if np.array_equal(grown, views):
            return views, refined
        views = grown
    return None
