"""The table of votes: where pixels lie in the cells, kept and read back as it was computed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from camera import Camera
from detect.circles import detect_circles
from detect.projection import circle_on_floor
from detect.settings import CircleSettings
from lut import VoteShape, build_vote_table, cached_vote_table
from lut.votes import radius_px
from tests.detect.painted_floor import PaintedFloor

SHAPE = VoteShape()


def test_pixels_lie_in_their_cells(published_camera: Camera) -> None:
    table = build_vote_table(published_camera, SHAPE)
    assert table.paired
    for k in range(0, len(table.image_row), 20):
        v = int(table.image_row[k])
        here = table.pixel[k, :, 1]
        counted = (here >= 0.0) & (here < len(table.row_of_step))
        seen = np.flatnonzero(table.pixel[k, :, 2:].any(axis=1) & counted)[::37]
        floor_xy = 0.5 * (table.floor_xy[v, 2 * seen] + table.floor_xy[v, 2 * seen + 1])
        across, ahead = ((floor_xy - table.foot) @ table.turn.T).T
        place = table.pixel[k, seen, :2]
        np.testing.assert_allclose(table.left + table.cell * place[:, 0], across, atol=1e-3)
        row = table.row_of_step[place[:, 1].astype(int)]
        apart = np.abs(table.ahead[row] - ahead)
        assert (apart < 0.6 * np.diff(table.ahead).max() + table.step).all()


def test_a_table_is_read_back_as_it_was_kept(published_camera: Camera, tmp_path: Path) -> None:
    built = build_vote_table(published_camera, SHAPE)
    cached_vote_table(published_camera, SHAPE, tmp_path)
    read = cached_vote_table(published_camera, SHAPE, tmp_path)
    for name, ours, theirs in zip(built._fields, read, built, strict=True):
        np.testing.assert_array_equal(ours, theirs, err_msg=name)
        assert isinstance(ours, type(theirs)), name


def test_a_camera_that_looks_straight_down_finds_discs() -> None:
    """On the mean, its pixels are right below it."""
    pose = (-1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 1.2)
    camera = Camera(320, 240, 250.0, 250.0, 160.0, 120.0, (0.0,) * 5, pose)
    places = np.array([(0.2, -0.1), (-0.3, 0.15), (0.35, 0.3)])
    floor = PaintedFloor(camera)
    for place in places:
        floor.disc(place)
    found = detect_circles(floor.image(), camera, build_vote_table(camera, SHAPE), CircleSettings())
    apart = np.hypot(*np.moveaxis(found.floor_xy[:, None] - places, -1, 0))
    assert len(found) == len(places)
    assert apart.min(axis=0).max() < 2e-3


def test_the_floor_at_the_horizon_takes_no_memory(published_camera: Camera) -> None:
    """Without a far limit, a row of pixels that nearly looks along the floor sees it 3e7 m away."""
    level = np.array([[-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, -1.0, 0.0, 1.2]])
    pose = tuple(map(tuple, level))
    level_camera = Camera(768, 288, 400.0, 200.0, 384.0, 143.99999, (0.0,) * 5, pose)
    table = build_vote_table(level_camera, VoteShape(far_limit_m_per_px=np.inf))
    assert 5.0 < table.ahead.max() < 100.0
    assert len(table.row_of_step) < 100_000


def test_sizes_are_those_of_the_outlines(published_camera: Camera) -> None:
    pixel = [500.0, 180.0]
    outline = circle_on_floor(published_camera.floor_from_pixel(pixel), 0.05, 64)
    x, y = published_camera.project_floor(outline).T
    area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    found = radius_px(0.05, published_camera.floor_jacobian(pixel))
    assert found == pytest.approx(np.sqrt(area / np.pi), rel=0.01)
