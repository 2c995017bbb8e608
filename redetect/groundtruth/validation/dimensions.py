"""What was measured in the building by tape: the drawing and the surveyed points held against it.

``dimensions.csv`` has the head ``name,x1_m,y1_m,x2_m,y2_m,measured_m`` and a row for each distance
between two points of the drawing; ``fiducial_distances.csv`` has the head ``a,b,distance_m`` and a
row for each distance between two fiducials.
"""

from __future__ import annotations

import math
import os
from typing import NamedTuple

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import known_name, read_table
from redetect.groundtruth.validation.reference_poses import Survey
from redetect.plane import apply, fitted, rotation

DIMENSIONS_HEAD = "name,x1_m,y1_m,x2_m,y2_m,measured_m"
FIDUCIAL_DISTANCES_HEAD = "a,b,distance_m"
_STEPS = 20


class Dimension(NamedTuple):
    """A distance that the drawing has and that was measured."""

    name: str
    drawn_m: float
    measured_m: float


class FiducialDistance(NamedTuple):
    """A measured distance between two fiducials."""

    a: str
    b: str
    distance_m: float


class SurveyedFiducials(NamedTuple):
    """Where F fiducials are by the distances between them."""

    names: tuple[str, ...]
    places: FloatArray  # (F, 2): moved rigidly onto those of the drawing (m)
    drawn: FloatArray  # (F, 2): in the drawing (m)
    sigma_m: FloatArray  # (F, 2): standard deviations of the places, by those of the distances
    residuals_m: FloatArray  # (K,): measured distances minus those between the places


def read_dimensions(path: str | os.PathLike[str]) -> list[Dimension]:
    """Read a ``dimensions.csv``."""
    found = []
    for _, (name,), (x1, y1, x2, y2, measured) in read_table(path, DIMENSIONS_HEAD, ("name",)):
        found.append(Dimension(name, math.hypot(x2 - x1, y2 - y1), measured))
    return found


def read_fiducial_distances(path: str | os.PathLike[str], survey: Survey) -> list[FiducialDistance]:
    """Read a ``fiducial_distances.csv``, which may name the survey's fiducials only."""
    found = []
    for line, names, (distance,) in read_table(path, FIDUCIAL_DISTANCES_HEAD, ("a", "b")):
        a, b = (known_name(path, line, name, survey.fiducials) for name in names)
        found.append(FiducialDistance(a, b, distance))
    return found


def survey_fiducials(survey: Survey, distances: list[FiducialDistance]) -> SurveyedFiducials:
    """Work the places of fiducials out from the distances between them, by least squares.

    Distances leave a rigid motion open: the places are moved onto those of the drawing, and the
    deviations are those of a free network (of least trace).

    Raises
    ------
    GroundTruthError
        If the distances leave more than that open.
    """
    names = tuple(survey.fiducials)
    drawn = np.stack([survey.fiducials[name] for name in names])
    ends = np.array([(names.index(d.a), names.index(d.b)) for d in distances]).reshape(-1, 2)
    measured = np.array([d.distance_m for d in distances])
    rows = np.arange(len(measured))
    places = drawn.copy()
    for _ in range(_STEPS):
        apart = places[ends[:, 0]] - places[ends[:, 1]]
        length = np.maximum(np.hypot(apart[:, 0], apart[:, 1]), 1e-9)
        jacobian = np.zeros((len(measured), len(names), 2))
        jacobian[rows, ends[:, 0]] += apart / length[:, None]
        jacobian[rows, ends[:, 1]] -= apart / length[:, None]
        flat = jacobian.reshape(len(measured), -1)
        step, _, rank, _ = np.linalg.lstsq(flat, measured - length, rcond=1e-9)
        if rank < 2 * len(names) - 3:
            raise GroundTruthError(
                f"{len(measured)} distances leave the places of {len(names)} fiducials open"
            )
        places = places + step.reshape(-1, 2)
    motion = fitted(places, drawn)
    variances = survey.sigma_m**2 * np.linalg.pinv(flat.T @ flat, rcond=1e-9)
    each = np.arange(len(names))
    blocks = variances.reshape(len(names), 2, len(names), 2)[each, :, each]
    turned = rotation(motion[2]) @ blocks @ rotation(motion[2]).T
    sigma = np.sqrt(np.diagonal(turned, axis1=1, axis2=2))
    return SurveyedFiducials(names, apply(motion, places), drawn, sigma, measured - length)
