"""Candidates by edges: at the discs, whatever hides half of them; and counted as plain sums."""

from __future__ import annotations

import numpy as np
import pytest

from camera import Camera
from camera.calibration.floor import with_pose
from detect.circles import disc_shape
from detect.discs.hough import count_votes, edges_of, hough_candidates
from detect.settings import CircleSettings
from lut import DiscShape, DiscTable, build_disc_table
from tests.detect.painted_floor import DARK, FLOOR, LIGHT, PaintedFloor

PLACES = np.array([(0.3, -1.2), (-0.5, -2.0), (0.5, -3.2)])


@pytest.fixture(scope="module")
def table(published_camera: Camera) -> DiscTable:
    return build_disc_table(published_camera, disc_shape(CircleSettings()))


@pytest.mark.parametrize(("grey", "sign"), [(LIGHT, 1.0), (DARK, -1.0)])
@pytest.mark.parametrize("half", [False, True])
def test_the_best_candidates_are_the_discs(
    published_camera: Camera, table: DiscTable, grey: float, sign: float, half: bool
) -> None:
    floor = PaintedFloor(published_camera)
    for place in PLACES:
        floor.disc(place, grey)
        if half:  # the floor's own grey value covers what lies on one side of the middle
            floor.shape(place, lambda x, y: x > 0.02, FLOOR)
    found = hough_candidates(floor.image(seed=1), published_camera, table, 0.1, sign, 4.0)
    assert (np.diff(found.score) <= 0.0).all()
    best = found.floor_xy[: len(PLACES)]
    distance = np.hypot(*np.moveaxis(best[:, None] - PLACES, -1, 0))
    assert sorted(distance.argmin(axis=1)) == [0, 1, 2]
    assert (distance.min(axis=1) < 0.05).all()
    other = hough_candidates(floor.image(seed=1), published_camera, table, 0.1, -sign, 4.0)
    assert not len(other.score) or other.score[0] < found.score[len(PLACES) - 1]


def test_a_camera_that_looks_back_sees_the_same(published_camera: Camera) -> None:
    """Directions about the camera's foot begin where nothing is seen."""
    turned = np.array(published_camera.robot_from_camera)
    turned[:2] *= -1.0
    camera = with_pose(published_camera, turned)
    table = build_disc_table(camera, disc_shape(CircleSettings()))
    for place in [(0.0, 1.3), (0.02, 2.0), (-0.02, 2.6)]:
        image = PaintedFloor(camera).disc(place).image(seed=4)
        found = hough_candidates(image, camera, table, 0.1, 1.0, 4.0)
        assert np.hypot(*(found.floor_xy[0] - place)) < 0.05


def test_a_table_without_centres_has_no_candidates(published_camera: Camera) -> None:
    table = build_disc_table(published_camera, DiscShape(far_limit_m_per_px=1e-9))
    image = PaintedFloor(published_camera).disc(PLACES[0]).image(seed=1)
    assert len(hough_candidates(image, published_camera, table, 0.1, 1.0, 4.0).score) == 0


def test_nothing_on_a_bare_floor(published_camera: Camera, table: DiscTable) -> None:
    image = PaintedFloor(published_camera).image(seed=2)
    found = hough_candidates(image, published_camera, table, 0.1, 1.0, 10.0)
    assert len(found.score) == 0


def test_votes_are_shares_of_the_rim(published_camera: Camera, table: DiscTable) -> None:
    """As sums over pixels one by one."""
    image = PaintedFloor(published_camera).disc(PLACES[0]).image(seed=3)
    edges, least, radius = edges_of(image), 120.0, 0.1
    origin, per_metre, size = np.array([-4.0, -8.0]), 20.0, 160
    raster = np.arange(size * size, dtype=np.int32).reshape(size, size)
    votes = count_votes(
        edges.along_u, edges.along_v, table.floor_xy, radius, least, raster, origin, per_metre,
        (0, size * size),
    )  # fmt: skip
    expected = np.zeros(size * size)
    gradient = np.stack([edges.along_u, edges.along_v], axis=-1).astype(float)
    strong = (gradient**2).sum(axis=-1) >= least**2
    strong[[0, -1]] = strong[:, [0, -1]] = False
    for v, u in zip(*np.nonzero(strong)):
        jacobian = np.stack(
            [table.floor_xy[v, u + 1] - table.floor_xy[v, u - 1],
             table.floor_xy[v + 1, u] - table.floor_xy[v - 1, u]], axis=-1,
        ) / 2.0  # fmt: skip
        if not np.isfinite(jacobian).all():
            continue
        normal = np.linalg.solve(jacobian.T.astype(float), gradient[v, u])
        normal /= np.hypot(*normal)
        column, row = np.floor((table.floor_xy[v, u] + radius * normal - origin) * per_metre)
        share = abs(np.linalg.det(jacobian)) / np.hypot(*(jacobian.T @ normal))
        expected[int(row) * size + int(column)] += share / (2.0 * np.pi * radius)
    # A vote near the border of a cell may fall on either side of it.
    assert votes.sum() == pytest.approx(expected.sum(), rel=1e-4)
    assert np.abs(votes - expected).sum() < 0.02 * expected.sum()
