"""Tables of a run for GTSAM, MRPT and the like, with columns as in docs/slam/formats.md.

Steps have two covariances: in the axes before the step, as in the data set's rows and MRPT's
Gaussian poses, and in those at its end (``end_``), as for the errors of GTSAM's BetweenFactorPose2
and g2o's EDGE_SE2.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from redetect.landmarks.axes import covariance_from_dataset, from_dataset
from redetect.slam.models import in_turned_axes
from redetect.slam.recording import Recording

_TRIANGLE_3 = ("cxx_m2", "cxy_m2", "cxphi_m_rad", "cyy_m2", "cyphi_m_rad", "cphiphi_rad2")
_ODOMETRY_COLUMNS = (
    *("step", "prefix", "dx_m", "dy_m", "dphi_rad"),
    *_TRIANGLE_3,
    *(f"end_{name}" for name in _TRIANGLE_3),
)
_DISC_COLUMNS = ("step", "prefix", "id", "x_m", "y_m", "cxx_m2", "cxy_m2", "cyy_m2")
_BEARING_COLUMNS = ("step", "prefix", "ids", "bearing_rad", "sigma_rad", "camera_x_m", "camera_y_m")
#: Columns and rows of a file.
_Table = tuple[tuple[str, ...], list[tuple[Any, ...]]]


def odometry_table(recording: Recording) -> _Table:
    """A run's steps."""
    steps = from_dataset(recording.steps)
    before = covariance_from_dataset(recording.step_covariance)
    after = in_turned_axes(before, steps[:, 2])
    triangles = [spread[:, *np.triu_indices(3)] for spread in (before, after)]
    numbers = np.concatenate([steps, *triangles], axis=1).tolist()
    rows = [(k + 1, name, *numbers[k]) for k, name in enumerate(recording.prefixes)]
    return _ODOMETRY_COLUMNS, rows


def disc_table(recording: Recording) -> _Table:
    """The measurements of discs that have an identifier."""
    some = recording.circles
    covariance = covariance_from_dataset(some.covariance)[:, *np.triu_indices(2)]
    numbers = np.concatenate([from_dataset(some.xy), covariance], axis=1).tolist()
    return _DISC_COLUMNS, [
        (some.frame[k] + 1, recording.prefixes[some.frame[k]], some.ids[k], *numbers[k])
        for k in np.flatnonzero(some.identified)
    ]


def bearing_table(recording: Recording, camera_xy: ArrayLike) -> _Table:
    """The bearings of verticals that have identifiers, from the camera's place (2,)."""
    some = recording.lines
    camera = from_dataset(camera_xy).tolist()
    names = [";".join(map(str, ids)) for ids in some.ids]
    numbers = np.column_stack([some.bearing_rad, some.sigma_rad]).tolist()
    return _BEARING_COLUMNS, [
        (some.frame[k] + 1, recording.prefixes[some.frame[k]], names[k], *numbers[k], *camera)
        for k in np.flatnonzero(some.identified)
    ]
