"""Verticals are told apart on a path that the discs give: rays of one meet in one point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle
from redetect.plane import chain_steps
from redetect.slam.association.line_points import (
    Rays,
    find_points,
    lines_by_points,
    rays_of,
)
from redetect.slam.association.scoring import score_association
from redetect.slam.models import bearing_of_vertical
from redetect.slam.recording import LineRows, Recording
from tests.slam.ekf_rows import circle_rows

CAMERA_XY = (0.02, -0.08)
SIGMA_RAD = 0.002


def seen(
    lines: FloatArray, seed: int, frames: int = 30, clutter: int = 2, heading_sigma_rad: float = 0.0
) -> tuple[Recording, FloatArray]:
    """A robot that drives straight on past verticals, and the path that it takes itself to drive.

    Rows that show nothing have no identifier. The heading of each frame is uncertain.
    """
    rng = np.random.default_rng(seed)
    steps = np.tile([0.0, -0.2, 0.01], (frames, 1))
    path = chain_steps(steps)
    rows: list[tuple[int, float, float, tuple[int, ...]]] = []
    for frame in range(frames):
        bearing = bearing_of_vertical(path[frame + 1], lines, CAMERA_XY)
        bearing = bearing + rng.normal(0.0, SIGMA_RAD, len(lines))
        shown = (np.abs(bearing) < 0.7) & (rng.random(len(lines)) < 0.9)
        rows += [
            (frame, float(bearing[k]), SIGMA_RAD, (int(k) + 1,)) for k in np.flatnonzero(shown)
        ]
        rows += [(frame, float(b), SIGMA_RAD, ()) for b in rng.uniform(-0.7, 0.7, clutter)]
    recording = Recording(
        prefixes=tuple(f"{k}" for k in range(frames)),
        steps=steps,
        step_covariance=np.tile(np.diag([1e-4, 1e-4, 1e-4]), (frames, 1, 1)),
        circles=circle_rows(),
        lines=LineRows.of(rows),
    )
    believed = path.copy()
    believed[1:, 2] += rng.normal(0.0, heading_sigma_rad, frames)
    return recording, believed


def edges_along_walls(seed: int) -> FloatArray:
    """Edges along both walls of a corridor."""
    rng = np.random.default_rng(seed)
    y = np.arange(-11.0, -2.0, 0.9)
    left = np.stack([rng.uniform(0.8, 1.3, len(y)), y], axis=1)
    right = np.stack([-rng.uniform(0.8, 1.3, len(y)), y + 0.4], axis=1)
    return np.concatenate([left, right])


def test_exact_rows_give_exact_points() -> None:
    lines = np.array([[1.0, -4.0], [-1.2, -5.0], [0.6, -7.5], [-0.9, -9.0]])
    recording, path = seen(lines, 1, clutter=0)
    exact = bearing_of_vertical(
        path[recording.lines.frame + 1],
        lines[[row[0] - 1 for row in recording.lines.ids]],
        CAMERA_XY,
    )
    recording = replace(recording, lines=replace(recording.lines, bearing_rad=exact))
    labels, points = find_points(rays_of(recording, path, CAMERA_XY, 1.0, 0.0))
    assert score_association(labels, list(recording.lines.ids)).right_rows == 1.0
    for label, point in enumerate(points):
        true = recording.lines.ids[int(np.flatnonzero(labels == label)[0])][0]
        np.testing.assert_allclose(point, lines[true - 1], atol=1e-5)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_points_are_where_the_verticals_stand(seed: int) -> None:
    lines = edges_along_walls(seed)
    recording, path = seen(lines, seed)
    labels, points = find_points(rays_of(recording, path, CAMERA_XY, 1.0, 0.0))
    score = score_association(labels, list(recording.lines.ids))
    assert score.pair_precision > 0.75
    assert score.right_rows > 0.8
    # Those that the robot comes near to; far ahead, edges along a wall look like one.
    for line in lines[lines[:, 1] > -7.0]:
        assert np.min(np.hypot(*(points - line).T)) < 0.1
    # A frame sees a vertical once.
    for label in range(len(points)):
        frames = recording.lines.frame[labels == label]
        assert len(np.unique(frames)) == len(frames)


def test_headings_that_are_off_are_found() -> None:
    lines = edges_along_walls(4)
    recording, path = seen(lines, 4, clutter=0, heading_sigma_rad=0.003)
    alone = np.arange(len(recording.lines))
    found, better = lines_by_points(
        recording, path, np.zeros(0, np.int64), alone, camera_xy=CAMERA_XY
    )
    true = chain_steps(recording.steps)[:, 2]
    before, after = (np.diff(wrap_angle(p[:, 2] - true)) for p in (path, better))
    assert np.std(after) < 0.4 * np.std(before)
    first, _ = find_points(rays_of(recording, path, CAMERA_XY, 1.0, 0.0))
    rows = list(recording.lines.ids)
    assert score_association(found, rows).right_rows > 0.75
    assert (
        score_association(found, rows).right_rows > score_association(first, rows).right_rows + 0.1
    )


def test_a_row_of_a_vertical_each_and_none_without() -> None:
    recording, path = seen(np.array([[-1.0, -9.0], [2.0, -10.0], [4.0, -11.0]]), 6, 30, clutter=0)
    shown = np.array([ids[0] for ids in recording.lines.ids])
    found, _ = lines_by_points(
        recording, path, np.zeros(0, np.int64), shown - 1, camera_xy=CAMERA_XY
    )
    np.testing.assert_array_equal(found[:, None] == found, shown[:, None] == shown)


def test_rows_without_a_point_keep_the_label_they_had() -> None:
    recording, path = seen(np.array([[500.0, -5000.0]]), 5, frames=14, clutter=0)
    before = np.repeat(np.arange(7), [2, 3, 1, 2, 4, 1, 1])[: len(recording.lines)]
    after, _ = lines_by_points(recording, path, np.zeros(0, np.int64), before, camera_xy=CAMERA_XY)
    same = before[:, None] == before
    np.testing.assert_array_equal(after[:, None] == after, same)


def test_frames_without_rows_and_runs_without_crossings_do_no_harm() -> None:
    none = np.zeros(0)
    start = np.zeros(6, dtype=np.int64)
    ahead = np.tile([1.0, 0.0], (5, 1))
    row = start[:0]
    empty = Rays(row, none.reshape(0, 2), none, none, none, row, start, ahead, 0.7)
    labels, points = find_points(empty)
    assert labels.shape == (0,)
    assert points.shape == (0, 2)
    # Rows in the first two and the last of five frames, none of them crossing another.
    rays = Rays(
        row=np.arange(3),
        centre=np.zeros((3, 2)),
        angle=np.array([0.1, 0.1, 0.1]),
        bearing=np.array([0.1, 0.1, 0.1]),
        sigma=np.full(3, 0.002),
        frame=np.array([0, 1, 4]),
        start=np.array([0, 1, 2, 2, 2, 3]),
        heading=ahead,
        widest_rad=0.7,
    )
    labels, points = find_points(rays)
    np.testing.assert_array_equal(labels, [-1, -1, -1])
    assert points.shape == (0, 2)


def test_the_same_rows_give_the_same_labels() -> None:
    recording, path = seen(edges_along_walls(6), 6)
    rays = rays_of(recording, path, CAMERA_XY, 1.5, 0.002)
    first, second = (find_points(rays) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
