"""Where lines are first placed: only where some two rays cross, however many there are."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from slam.mapping.initial_lines import place_lines, triangulate
from slam.models.measurement import bearing_of_vertical
from slam.recording import LineRows

FloatArray = NDArray[np.float64]
CAMERA_XY = np.array([0.05, -0.1])


@given(st.lists(st.floats(-3.1, 3.1), min_size=2, max_size=7), st.floats(-3.0, 3.0))
def test_a_line_is_placed_if_two_of_its_rays_cross_widely_enough(
    directions: list[float], spread: float
) -> None:
    """The widest crossing decides, whichever two of the rays make it."""
    courses = spread * np.array(directions)
    apart = np.abs(courses[:, None] - courses) % np.pi
    widest = float(np.max(np.minimum(apart, np.pi - apart)))
    assume(widest > 0.01)
    line = np.array([3.0, -2.0])
    # All rays, 4 m long, end in the line.
    poses = np.column_stack(
        [line - 4.0 * np.column_stack([np.sin(courses), -np.cos(courses)]), courses]
    )
    sigma = np.full(len(courses), 1e-3)
    below = triangulate(poses, 0.0 * courses, sigma, np.zeros(2), widest - 1e-6)
    assert below is not None
    np.testing.assert_allclose(below, line, atol=1e-6)
    assert triangulate(poses, 0.0 * courses, sigma, np.zeros(2), widest + 1e-6) is None


def test_a_line_seen_twenty_thousand_times_is_placed() -> None:
    """A table of all pairs of its rays would take gigabytes."""
    angle = np.linspace(0.0, 40.0, 20_000)
    poses = np.column_stack([3.0 * np.sin(angle), 3.0 * np.cos(angle), 0.1 * angle])
    line = np.array([0.5, -0.3])
    bearing = bearing_of_vertical(poses[1:], line, CAMERA_XY)
    count = len(bearing)
    rows = LineRows(np.arange(count), bearing, np.full(count, 0.002), ((4,),) * count)
    placed = place_lines(poses, rows, CAMERA_XY)
    assert placed.ids.tolist() == [4]
    np.testing.assert_allclose(placed.xy[0], line, atol=1e-6)
