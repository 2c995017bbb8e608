"""Calibrations that are a little wrong, as real ones are, and say how wrong they may be."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from camera import Camera
from redetect.groundtruth.geometry.transforms import exp_se3
from redetect.groundtruth.markers.calibration import Network, Rig
from tools.simulator.markers.surface import FloatArray


@dataclass(frozen=True)
class CalibrationErrors:
    """Standard deviations of the errors in what a session's files say of cameras and robot."""

    network_m: float = 0.0
    """Of each camera's place along each axis (m)."""
    network_deg: float = 0.0
    """Of each camera's rotation about each axis (degrees)."""
    rig_m: float = 0.0
    """Of each marker's place on the robot along each axis (m)."""
    rig_deg: float = 0.0
    """Of each marker's rotation about each axis (degrees)."""
    focal: float = 0.0
    """Of the focal lengths, as a share of them."""
    centre_px: float = 0.0
    """Of the principal point along each axis (pixels)."""

    @property
    def any(self) -> bool:
        """Whether there are errors at all."""
        return any(vars(self).values())


def disturbed_network(
    network: Network, errors: CalibrationErrors, rng: np.random.Generator
) -> Network:
    """The network as a calibration with such errors would have it, covariances included.

    Parameters
    ----------
    network : Network
        The true one.
    errors : CalibrationErrors
        How wrong to be.
    rng : numpy Generator
        Source of the errors.

    Returns
    -------
    Network
        The covariance says how wrong the poses may be; that the lenses are wrong nothing says.
    """
    count = len(network.names)
    sigmas = _sigmas(errors.network_m, errors.network_deg)
    poses = network.world_from_camera @ exp_se3(sigmas * rng.standard_normal((count, 6)))
    cameras = tuple(_disturbed_lens(camera, errors, rng) for camera in network.cameras)
    return replace(
        network, cameras=cameras, world_from_camera=poses,
        covariance=np.diag(np.tile(sigmas**2, count)),
    )  # fmt: skip


def disturbed_rig(rig: Rig, errors: CalibrationErrors, rng: np.random.Generator) -> Rig:
    """The rig as a calibration with such errors would have it; see `disturbed_network`."""
    count = len(rig.ids)
    sigmas = _sigmas(errors.rig_m, errors.rig_deg)
    poses = rig.robot_from_marker @ exp_se3(sigmas * rng.standard_normal((count, 6)))
    return replace(rig, robot_from_marker=poses, covariance=np.diag(np.tile(sigmas**2, count)))


def _disturbed_lens(camera: Camera, errors: CalibrationErrors, rng: np.random.Generator) -> Camera:
    factor = 1.0 + errors.focal * rng.standard_normal()
    du, dv = errors.centre_px * rng.standard_normal(2)
    return replace(
        camera, scale_x=camera.scale_x * factor, scale_y=camera.scale_y * factor,
        offset_x=camera.offset_x + float(du), offset_y=camera.offset_y + float(dv),
    )  # fmt: skip


def _sigmas(metres: float, degrees: float) -> FloatArray:
    return np.repeat([metres, np.radians(degrees)], 3)
