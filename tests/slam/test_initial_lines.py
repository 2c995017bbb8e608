"""Where lines are first placed: only where rays say where they are, however many there are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from camera import Camera
from redetect.least_squares import LossKind
from redetect.plane import apply
from redetect.slam.mapping.graph import (
    MOST_SIGMA_M,
    Estimate,
    graph_of_recording,
    place_lines,
    well_placed,
    with_lines,
)
from redetect.slam.mapping.graph_terms import Weighting
from redetect.slam.mapping.run_map import map_run
from redetect.slam.models import bearing_of_vertical
from redetect.slam.recording import LineRows
from tests.slam.small_run import small_run

CAMERA_XY = np.array([0.05, -0.1])


@given(st.lists(st.floats(-3.1, 3.1), min_size=2, max_size=7), st.floats(-3.0, 3.0))
def test_a_line_is_placed_if_its_rays_say_where_it_is(
    directions: list[float], spread: float
) -> None:
    """Along the direction in which they say least, too."""
    courses, sigma = spread * np.array(directions), 0.02
    across = np.column_stack([np.cos(courses), np.sin(courses)])
    weakest = np.linalg.eigvalsh(across.T @ across)[0] / (4.0 * sigma) ** 2
    assume(abs(weakest * MOST_SIGMA_M**2 - 1.0) > 1e-3)
    line = np.array([3.0, -2.0])
    # All rays, 4 m long, end in the line.
    poses = np.column_stack(
        [line - 4.0 * np.column_stack([np.sin(courses), -np.cos(courses)]), courses]
    )
    count = len(courses)
    rows = LineRows(np.arange(count), 0.0 * courses, np.full(count, sigma), ((4,),) * count)
    found = place_lines(np.concatenate([poses[:1], poses]), rows, np.zeros(2))
    if weakest * MOST_SIGMA_M**2 > 1.0:
        np.testing.assert_allclose(found.xy, [line], atol=1e-6)
    else:
        assert found.unplaced.tolist() == [4]


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


def test_lines_that_bearings_do_not_place_are_found_at_an_estimate() -> None:
    run = small_run(3)
    graph = replace(graph_of_recording(run.recording), camera_xy=CAMERA_XY)
    ids = np.arange(1, len(run.line_xy) + 1)
    graph = with_lines(graph, run.recording.lines, ids)
    xy = run.line_xy.copy()
    assert np.all(well_placed(graph, Estimate(run.poses, run.disc_xy, xy)))
    middle = run.poses[:, :2].mean(axis=0)
    xy[1] = middle + 500.0 * (xy[1] - middle)  # as good as at infinity
    xy[2] = middle - 3.0 * (xy[2] - middle)  # on the other side of the robot
    seen_from = run.poses[graph.line_pose[graph.member_row[graph.member_line == 3]]]
    xy[3] = apply(seen_from[:1], [CAMERA_XY + np.array([-0.01, 0.005])])[0]  # at a camera
    placed = well_placed(graph, Estimate(run.poses, run.disc_xy, xy))
    assert np.flatnonzero(~placed).tolist() == [1, 2, 3]


@pytest.mark.parametrize("loss", ["none", "huber", "geman-mcclure"])
def test_a_line_seen_from_one_place_does_not_spoil_the_map(
    published_camera: Camera, loss: LossKind
) -> None:
    """Its rays are parallel but for one that is another line's."""
    run = small_run(3)
    lines = run.recording.lines
    count = 6
    spoilt = replace(
        lines,
        frame=np.concatenate([lines.frame, np.arange(count)]),
        bearing_rad=np.concatenate([lines.bearing_rad, 0.3 - run.poses[1 : count + 1, 2], [0.8]])[
            : len(lines) + count
        ],
        sigma_rad=np.full(len(lines) + count, 0.004),
        ids=lines.ids + ((99,),) * count,
    )
    spoilt.bearing_rad[-1] += 0.2
    mapped = map_run(replace(run.recording, lines=spoilt), published_camera, Weighting(loss=loss))
    clean = map_run(run.recording, published_camera, Weighting(loss=loss))
    assert mapped.graph.line_ids.tolist() == clean.graph.line_ids.tolist()
    assert mapped.left_out.lines_without_parallax == clean.left_out.lines_without_parallax + 1
    np.testing.assert_allclose(mapped.estimate.poses, clean.estimate.poses, atol=1e-4)
