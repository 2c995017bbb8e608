"""Measured by tape: dimensions and fiducials come back, and what leaves places open is refused."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.validation.reference_poses import (
    DIMENSIONS_HEAD,
    FIDUCIAL_DISTANCES_HEAD,
    FiducialDistance,
    Survey,
    read_dimensions,
    read_fiducial_distances,
    survey_fiducials,
)

PLACES = {"SW": (0.0, 0.0), "SE": (10.0, 0.0), "NE": (10.0, 7.5), "NW": (0.0, 7.5), "S": (5.2, 0)}
SURVEY = Survey({name: np.array(xy) for name, xy in PLACES.items()}, {}, 0.005)


def measured(rng: np.random.Generator | None = None) -> list[FiducialDistance]:
    return [
        (a, b, math.dist(PLACES[a], PLACES[b]) + (
            0.0 if rng is None else rng.normal(0.0, SURVEY.sigma_m)))
        for a, b in combinations(PLACES, 2)
    ]  # fmt: skip


def test_files_are_read_and_malformed_rows_refused(tmp_path: Path) -> None:
    path = tmp_path / "dimensions.csv"
    path.write_text(f"{DIMENSIONS_HEAD}\nroom,0,0,3,4,5.01\n")
    assert read_dimensions(path) == [("room", 5.0, 5.01)]
    path.write_text("room,0,0,3,4\n")
    with pytest.raises(GroundTruthError, match=":1: 5 words: expected name"):
        read_dimensions(path)
    path.write_text(f"{FIDUCIAL_DISTANCES_HEAD}\nSW,SE,10.002\n")
    assert read_fiducial_distances(path, SURVEY) == [("SW", "SE", 10.002)]
    path.write_text("SW,X,10.002\n")
    with pytest.raises(GroundTruthError, match=":1: 'X': expected one of SW, SE"):
        read_fiducial_distances(path, SURVEY)


def test_a_wrong_drawing_does_not_move_the_surveyed_fiducials() -> None:
    """Distances say where a fiducial is; the drawing only where all of them are together."""
    drawn = {name: np.array(xy) for name, xy in PLACES.items()}
    drawn["NE"] = drawn["NE"] + [0.08, -0.05]
    found = survey_fiducials(Survey(drawn, {}, 0.005), measured())
    truth = np.array([PLACES[name] for name in found.names])
    apart = found.places[:, None] - found.places
    np.testing.assert_allclose(np.hypot(*apart.T), np.hypot(*(truth[:, None] - truth).T), atol=1e-9)
    off = np.hypot(*(found.places - found.drawn).T)
    assert found.names[int(np.argmax(off))] == "NE"
    assert np.abs(found.residuals_m).max() < 1e-9


def test_deviations_are_those_of_the_errors() -> None:
    rng = np.random.default_rng(1)
    errors, sigmas = [], []
    for _ in range(300):
        found = survey_fiducials(SURVEY, measured(rng))
        errors.append(found.places - found.drawn)
        sigmas.append(found.sigma_m)
    np.testing.assert_allclose(np.std(errors, axis=0), np.mean(sigmas, axis=0), rtol=0.15)
    squared = sum(np.sum((survey_fiducials(SURVEY, measured(rng)).residuals_m / 0.005) ** 2)
                  for _ in range(100))  # fmt: skip
    low, high = chi2.ppf([0.001, 0.999], 300)  # 10 distances, 7 unknowns: 3 each
    assert low < squared < high


@pytest.mark.parametrize("count", [0, 5])
def test_too_few_distances_are_refused(count: int) -> None:
    with pytest.raises(GroundTruthError, match="not determine the positions of 5 fiducials"):
        survey_fiducials(SURVEY, measured()[:count])
