"""The robot's outline: faces, the motions that map it onto itself, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.outline import (
    outline_faces,
    outline_symmetries,
    robot_body,
)
from tests.groundtruth.lasers.scene import FRONTED, PLAIN

FloatArray = NDArray[np.float64]


def test_faces_run_counter_clockwise_whichever_way_the_file_goes() -> None:
    for corners in (PLAIN, PLAIN[::-1]):
        faces = outline_faces(corners)
        twice = np.sum(faces[:, 0] * faces[:, 3] - faces[:, 2] * faces[:, 1])
        assert twice == pytest.approx(2 * 0.42)
    body = robot_body(PLAIN)
    assert body.middle == pytest.approx([-0.05, 0.0])
    assert body.radius_m == pytest.approx(np.hypot(0.35, 0.3))


def test_symmetries() -> None:
    plain = outline_symmetries(outline_faces(PLAIN))
    assert plain == pytest.approx(np.array([[-0.1, 0.0, -np.pi]]), abs=1e-6)
    square = outline_symmetries(outline_faces([[0, 0], [1, 0], [1, 1], [0, 1]]))
    assert square[:, 2] == pytest.approx([-np.pi, -np.pi / 2, np.pi / 2], abs=1e-3)
    assert len(outline_symmetries(outline_faces(FRONTED))) == 0
    # Within 0.12 m its front can be mistaken for its back.
    assert outline_symmetries(outline_faces(FRONTED), 0.12)[0, 2] == pytest.approx(-np.pi)
    assert len(outline_symmetries(outline_faces(np.array([[0, 0], [1, 0], [0.2, 0.7]])))) == 0


def test_outlines_that_are_none() -> None:
    with pytest.raises(GroundTruthError, match="cross"):
        outline_faces(np.array([[0, 0], [1, 1.5], [1, 0], [0, 1]]))
    with pytest.raises(GroundTruthError, match="the same"):
        outline_faces([[0, 0], [0, 0], [1, 1]])
    with pytest.raises(GroundTruthError, match="encloses"):
        outline_faces([[0, 0], [1, 0], [2, 0]])
    with pytest.raises(GroundTruthError, match=r"folds back at \[1.0, 0.0\]"):
        outline_faces(np.array([[0, 0], [1, 0], [0.5, 0], [0.5, 1]]))
