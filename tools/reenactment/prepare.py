"""From a recording to a world, in stages each of which begins where the one before ended."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from camera import Camera
from tools.arrays import FloatArray
from tools.reenactment.associations import mend_associations
from tools.reenactment.fitting import (
    RefitError,
    Weighting,
    mahalanobis,
    nominal_geometry,
    odometry_residuals,
    refit,
)
from tools.reenactment.mounted_discs import Geometry, predict_pixels
from tools.reenactment.recording import Recording, start_from_odometry
from tools.reenactment.world import World

#: A row counts as found again within so many standard deviations of its shipped covariance.
GATE_SIGMA = 4.0

# Odometry alone leads some 50 m astray: a wide bound lets the discs pull the path together.
_PULL_TOGETHER = Weighting(robust_scale=10.0, mounting=False)
_LEAST_SQUARES = Weighting()
_ROBUST = Weighting(robust_scale=4.0)
# What is rendered has to look right in every frame, near discs (whose published covariance is
# worth many pixels) included: so errors count in pixels, odometry counts little, and each frame
# has a tilt. The figures were chosen for the share of rows that come out inside the image's tables.
_AS_SEEN = Weighting(
    metric="pixel",
    pixel_sigma=2.0,
    robust_scale=6.0,
    odometry_scale=8.0,
    tilt_sigma=float(np.radians(0.5)),
)
_COARSE, _FINE = 1e-4, 1e-6
_MOST_MENDINGS = 10


@dataclass(frozen=True)
class Quality:
    """How well a geometry explains a recording."""

    label: str  # The stage it came from.
    chi_squared: float  # Of odometry and the rows in sight, under the file's own covariances.
    out_of_sight: int  # Rows whose disc lies where the camera can't see it.
    rotation: tuple[float, float, float]
    """Rotation vector from nominal to true mounting, robot frame, radians."""
    height: float  # True minus nominal height, metres.
    tilt_deg: tuple[float, float]  # Root mean square of pitch and roll, degrees.
    discs: int  # Number of discs.
    share: float  # Of rows predicted within `GATE_SIGMA`.
    share_whole_pixel: float
    """The same after rounding the predictions to whole pixels, as the published detector does."""
    median_px: float  # Median distance of the rows' pixels from the predicted ones.


@dataclass(frozen=True, eq=False)
class Stage:
    """A geometry on the way, the recording as mended so far, and how they agree."""

    geometry: Geometry
    recording: Recording
    quality: Quality


def assess(label: str, camera: Camera, recording: Recording, geometry: Geometry) -> Quality:
    """Measure how well a geometry explains a recording (see `Quality`)."""
    from scipy.spatial.transform import Rotation

    pixels, _ = predict_pixels(camera, geometry, recording.frame, recording.disc)
    rows = recording.row_xy, recording.row_covariance
    distance = mahalanobis(camera, pixels, *rows)
    whole = mahalanobis(camera, np.round(pixels), *rows)
    seen = np.isfinite(distance)
    steps = odometry_residuals(geometry.poses, recording.steps)
    weighted = np.linalg.solve(recording.step_covariance, steps[..., None])[..., 0]
    turn = Rotation.from_matrix(geometry.rotation @ np.linalg.inv(camera.rotation)).as_rotvec()
    pitch, roll = np.degrees(np.sqrt(np.mean(geometry.tilt**2, axis=0)))
    return Quality(
        label=label,
        chi_squared=float(np.sum(distance[seen] ** 2) + np.sum(steps * weighted)),
        out_of_sight=int(np.sum(~seen)),
        rotation=(float(turn[0]), float(turn[1]), float(turn[2])),
        height=float(geometry.centre[2] - camera.centre[2]),
        tilt_deg=(float(pitch), float(roll)),
        discs=len(geometry.disc_xy),
        share=float(np.mean(distance <= GATE_SIGMA)),
        share_whole_pixel=float(np.mean(whole <= GATE_SIGMA)),
        median_px=float(np.median(np.linalg.norm(pixels - recording.pixels, axis=1)[seen])),
    )


def stages(
    camera: Camera, recording: Recording, start: tuple[FloatArray, FloatArray] | None
) -> Iterator[Stage]:
    """Fit a world to a recording, better with each stage. `start` (N, 3)."""

    def stage(label: str, geometry: Geometry) -> Stage:
        return Stage(geometry, recording, assess(label, camera, recording, geometry))

    if start is None:
        geometry = nominal_geometry(camera, *start_from_odometry(recording))
        yield stage("odometry", geometry)
        fit = refit(camera, recording, geometry, _PULL_TOGETHER, tolerance=_COARSE)
        yield stage("robust, nominal mounting", fit.geometry)
    else:
        geometry = nominal_geometry(camera, *start)
        yield stage("given path and map", geometry)
        fit = refit(camera, recording, geometry, _LEAST_SQUARES)
        yield stage("least squares, true mounting", fit.geometry)
    fit = refit(camera, recording, fit.geometry, _ROBUST, tolerance=_FINE)
    yield stage("robust, true mounting", fit.geometry)
    fit = refit(camera, recording, fit.geometry, _AS_SEEN, tolerance=_FINE)
    yield stage("in pixels, tilting robot", fit.geometry)
    for _ in range(_MOST_MENDINGS):
        mending = mend_associations(camera, recording, fit.geometry, gate=GATE_SIGMA)
        if not mending.changes:
            break
        recording = mending.recording
        fit = refit(camera, recording, mending.geometry, _AS_SEEN, tolerance=_FINE)
    else:
        raise RefitError(f"rows change their discs after {_MOST_MENDINGS} rounds still")
    yield stage("IDs mended", fit.geometry)


def world_of_stage(stage: Stage) -> World:
    """What a simulator needs of a stage."""
    geometry = stage.geometry
    return World(
        prefixes=stage.recording.prefixes,
        poses=geometry.poses,
        tilt=geometry.tilt,
        disc_ids=stage.recording.disc_ids,
        disc_xy=geometry.disc_xy,
        robot_from_camera=np.concatenate([geometry.rotation, geometry.centre[:, None]], axis=1),
    )
