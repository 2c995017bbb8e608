"""Bearings and inclinations against the published rows; laws of joining."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from camera import Camera
from detect.verticals.joining import chain_neighbours, join_mixtures
from detect.verticals.tilt import TiltEstimate, levelling_rotation
from redetect.landmarks import LineLandmark
from tests.landmarks.rows import parse_record
from tests.reference.verticals import (
    close_groups,
    compensated_bearings,
    inclinations,
    join_bearings,
    level_bearings,
    plane_normals,
)

#: Rows of one edge each (the joined ones have a larger sigma); the report's figures 10 and 11.
UNJOINED = {"e.0000": (0, 2, 3, 4), "e.0001": (0, 1)}
#: The tilt by which the rows of e.0000 were turned, found by least squares over their alphas.
TILT_E0000 = TiltEstimate(-0.036596, 0.010553, np.eye(2), 6)


@pytest.fixture(scope="module")
def published_rows(shared_data: Path) -> dict[str, list[LineLandmark]]:
    published = json.loads((shared_data / "published.json").read_text())
    rows: dict[str, list[LineLandmark]] = {}
    for line in published["lines"]:
        record = parse_record(line["row"])
        assert isinstance(record, LineLandmark)
        rows.setdefault(line["step"], []).append(record)
    return rows


def normals_of(rows: list[LineLandmark], camera: Camera) -> np.ndarray:
    ends = np.array([[row.xtop, row.ytop, row.xbottom, row.ybottom] for row in rows])
    return plane_normals(ends, camera.rotation)


@pytest.mark.parametrize("step", ["e.0000", "e.0001"])
def test_published_inclinations(
    published_rows: dict[str, list[LineLandmark]], published_camera: Camera, step: str
) -> None:
    rows = [published_rows[step][k] for k in UNJOINED[step]]
    # The ends are printed with 6 digits; the shortest line turns the last of them into 5e-6.
    printed = [row.beta for row in rows]
    np.testing.assert_allclose(inclinations(normals_of(rows, published_camera)), printed, atol=5e-6)


def test_published_bearings(
    published_rows: dict[str, list[LineLandmark]], published_camera: Camera
) -> None:
    rows = [published_rows["e.0000"][k] for k in UNJOINED["e.0000"]]
    normal = normals_of(rows, published_camera)
    alpha = compensated_bearings(normal, TILT_E0000, published=True)
    np.testing.assert_allclose(alpha, [row.alpha for row in rows], atol=1e-6)
    # Without compensation, and with the right sign, they are far off the printed ones.
    assert np.abs(level_bearings(normal, 0.0, 0.0) - [row.alpha for row in rows]).min() > 5e-4
    right = compensated_bearings(normal, TILT_E0000)
    assert np.abs(right - [row.alpha for row in rows]).min() > 5e-4


@given(
    bearing=st.floats(-1.4, 1.4),
    low=st.floats(-0.6, -0.05),
    high=st.floats(0.05, 0.6),
    pitch=st.floats(-0.08, 0.08),
    roll=st.floats(-0.08, 0.08),
)
def test_compensation_gives_the_bearing_of_a_vertical_back(
    bearing: float, low: float, high: float, pitch: float, roll: float
) -> None:
    """A camera that is tilted by R sees directions R' times the level ones."""
    level = np.array([np.sin(bearing), -np.cos(bearing), 0.0])
    ends = [level + np.array([0.0, 0.0, z]) for z in (high, low)]
    seen = [end @ levelling_rotation(pitch, roll) for end in ends]
    normal = np.cross(seen[0], seen[1])
    normal /= np.linalg.norm(normal)
    assert level_bearings(normal, pitch, roll) == pytest.approx(bearing, abs=1e-9)


def joined(alpha: np.ndarray, sigma: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Mean and deviation of a mixture, behind another one."""
    two = [np.concatenate([values[:1], values]) for values in (alpha, sigma, weight)]
    means, deviations = join_mixtures(two[0], two[1], two[2], np.array([0, 1, len(two[0])]))
    assert (means[0], deviations[0]) == pytest.approx((two[0][0], two[1][0]))
    return float(means[1]), float(deviations[1])


components = st.integers(1, 6).flatmap(
    lambda n: st.tuples(
        hnp.arrays(np.float64, n, elements=st.floats(-0.2, 0.2)),
        hnp.arrays(np.float64, n, elements=st.floats(1e-4, 0.02)),
        hnp.arrays(np.float64, n, elements=st.floats(0.1, 10.0)),
        st.floats(-3.2, 3.2),
        st.permutations(range(n)),
    )
)


@given(components)
def test_joining_conserves_mean_and_variance(
    mixture: tuple[np.ndarray, np.ndarray, np.ndarray, float, list[int]],
) -> None:
    offset, sigma, weight, turn, _ = mixture
    alpha = (offset + turn + np.pi) % (2 * np.pi) - np.pi
    mean, deviation = joined(alpha, sigma, weight)
    np.testing.assert_allclose((mean, deviation), join_bearings(alpha, sigma, weight), atol=1e-9)
    share = weight / weight.sum()
    expected = share @ offset
    assert abs((mean - turn - expected + np.pi) % (2 * np.pi) - np.pi) < 1e-9
    second_moment = share @ (sigma**2 + offset**2)
    assert deviation**2 == pytest.approx(second_moment - expected**2, rel=1e-6, abs=1e-12)


@given(components)
def test_joining_does_not_depend_on_the_order(
    mixture: tuple[np.ndarray, np.ndarray, np.ndarray, float, list[int]],
) -> None:
    offset, sigma, weight, _, order = mixture
    straight = joined(offset, sigma, weight)
    shuffled = joined(offset[order], sigma[order], weight[order])
    np.testing.assert_allclose(shuffled, straight, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(
        chain_neighbours(offset[order], np.full(len(offset), 0.02)),
        close_groups(offset, np.full(len(offset), 0.02))[order],
    )


def test_chains_of_neighbours_from_left_to_right() -> None:
    alpha = np.array([0.10, -0.30, 0.105, 0.50, 0.114])
    np.testing.assert_array_equal(chain_neighbours(alpha, np.full(5, 0.01)), [1, 2, 1, 0, 1])
    # The smaller of two distances decides: 0.105 is on its own.
    np.testing.assert_array_equal(
        chain_neighbours(alpha, np.array([0.01, 0.01, 0.002, 0.01, 0.01])), [3, 4, 2, 0, 1]
    )
    assert len(chain_neighbours(np.zeros(0), np.zeros(0))) == 0
