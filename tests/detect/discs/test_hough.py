"""Candidates by edges: at the discs, whatever hides half of them; and counted as plain sums."""

from __future__ import annotations

import numpy as np
import pytest

from camera import Camera
from camera.uncertainty import with_pose
from detect.discs.hough import count_votes, hough_candidates
from lut import VoteShape, VoteTable, build_vote_table
from tests.detect.painted_floor import DARK, FLOOR, LIGHT, PaintedFloor

PLACES = np.array([(0.3, -1.2), (-0.5, -2.0), (0.5, -3.2)])


@pytest.mark.parametrize(("grey", "sign"), [(LIGHT, 1), (DARK, -1)])
@pytest.mark.parametrize("half", [False, True])
def test_the_best_candidates_are_the_discs(
    published_camera: Camera, table: VoteTable, grey: float, sign: int, half: bool
) -> None:
    floor = PaintedFloor(published_camera)
    for place in PLACES:
        floor.disc(place, grey)
        if half:  # the floor's own grey value covers what lies on one side of the middle
            floor.shape(place, lambda x, y: x > 0.02, FLOOR)
    found = hough_candidates(floor.image(seed=1), table, 0.1, sign, 4.0)
    assert (np.diff(found.score) <= 0.0).all()
    best = found.floor_xy[: len(PLACES)]
    distance = np.hypot(*np.moveaxis(best[:, None] - PLACES, -1, 0))
    assert sorted(distance.argmin(axis=1)) == [0, 1, 2]
    assert (distance.min(axis=1) < 0.05).all()
    other = hough_candidates(floor.image(seed=1), table, 0.1, -sign, 4.0)
    assert not len(other.score) or other.score[0] < found.score[len(PLACES) - 1]


def test_a_camera_that_looks_back_sees_the_same(published_camera: Camera) -> None:
    """Directions about the camera's foot begin where nothing is seen."""
    turned = np.array(published_camera.robot_from_camera)
    turned[:2] *= -1.0
    camera = with_pose(published_camera, turned)
    table = build_vote_table(camera, VoteShape())
    for place in [(0.0, 1.3), (0.02, 2.0), (-0.02, 2.6)]:
        image = PaintedFloor(camera).disc(place).image(seed=4)
        found = hough_candidates(image, table, 0.1, 1, 4.0)
        assert np.hypot(*(found.floor_xy[0] - place)) < 0.05


def test_a_table_without_centres_has_no_candidates(published_camera: Camera) -> None:
    table = build_vote_table(published_camera, VoteShape(far_limit_m_per_px=1e-9))
    image = PaintedFloor(published_camera).disc(PLACES[0]).image(seed=1)
    assert len(hough_candidates(image, table, 0.1, 1, 4.0).score) == 0


def test_both_signs_are_those_of_each(published_camera: Camera, table: VoteTable) -> None:
    image = PaintedFloor(published_camera).disc(PLACES[0]).disc(PLACES[1], DARK).image(seed=5)
    both = hough_candidates(image, table, 0.1, 0, 4.0)
    for sign in (1, -1):
        of_sign = hough_candidates(image, table, 0.1, sign, 4.0)
        np.testing.assert_array_equal(both.floor_xy[both.sign == sign], of_sign.floor_xy)
        np.testing.assert_array_equal(both.score[both.sign == sign], of_sign.score)
        assert (of_sign.sign == sign).all()


def test_nothing_on_a_bare_floor(published_camera: Camera, table: VoteTable) -> None:
    image = PaintedFloor(published_camera).image(seed=2)
    found = hough_candidates(image, table, 0.1, 1, 10.0)
    assert len(found.score) == 0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_votes_are_shares_of_the_rim(
    published_camera: Camera, table: VoteTable, sign: float
) -> None:
    """As sums over pixels one by one."""
    image = PaintedFloor(published_camera).disc(PLACES[0]).image(seed=3)
    least, radius = 6.0, 0.1
    assert table.paired
    votes = count_votes(image, table, np.array([-sign * radius, sign * radius]), least)[1]
    grey = image.astype(float)[:, ::2] / 2.0 + image.astype(float)[:, 1::2] / 2.0
    floor_xy = (table.floor_xy[:, ::2].astype(float) + table.floor_xy[:, 1::2]) / 2.0
    expected = np.zeros(votes.shape)
    weight = np.diff(np.append(table.image_row, len(image) - 1))
    for v, rows in zip(table.image_row, weight, strict=True):
        for u in range(1, grey.shape[1] - 1):
            near = grey[v - 1 : v + 2, u - 1 : u + 2]
            smooth = np.array([1.0, 2.0, 1.0]) / 8.0
            gradient = np.array([smooth @ (near[:, 2] - near[:, 0]), (near[2] - near[0]) @ smooth])
            if np.hypot(*gradient) < least:
                continue
            jacobian = np.stack(
                [floor_xy[v, u + 1] - floor_xy[v, u - 1], floor_xy[v + 1, u] - floor_xy[v - 1, u]],
                axis=-1,
            ) / 2.0  # fmt: skip
            normal = np.linalg.solve(jacobian.T, gradient)
            normal /= np.hypot(*normal)
            centre = floor_xy[v, u] + sign * radius * normal - table.foot
            across, ahead = table.turn @ centre
            row = np.abs(table.ahead - ahead).argmin()
            column = int((across - table.left) / table.cell)
            share = abs(np.linalg.det(jacobian)) / np.hypot(*(jacobian.T @ normal))
            expected[row, column] += rows * share / (2.0 * np.pi * radius)
    assert votes.sum() == pytest.approx(expected.sum(), rel=1e-3)
    # A vote near the border of a cell may fall on either side of it.
    assert np.abs(votes - expected).sum() < 0.1 * expected.sum()
    if sign > 0.0:
        assert 1.0 < votes.sum() < 5.0  # of a rim, as wide as its blur and gradient
