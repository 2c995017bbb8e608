"""Rays against the camera's own projection; what they meet against known geometry."""

from __future__ import annotations

import numpy as np
import pytest

from camera import Camera
from redetect.slam.models import disc_in_robot
from tests.pictures import centroid
from tools.simulator.driving import planar_transform, tilted_camera
from tools.simulator.ray_kernels import NOTHING, nearest_quad, points_visible
from tools.simulator.renderer import Light, render_light, smeared
from tools.simulator.scene import (
    Construction,
    Flooring,
    FloorMark,
    Look,
    Mark,
    Scene,
    make_scene,
    raster_shape,
)
from tools.simulator.single_disc import render_disc

EXTENT = (-12.0, -12.0, 12.0, 12.0)
WHITE, GREY = 1.0, 0.2


def _scene(building: Construction) -> Scene:
    """A floor without texture in even light; no ceiling."""
    shape = raster_shape(EXTENT)
    scene = make_scene(
        building, EXTENT, np.zeros(shape, dtype=np.int8),
        np.array([[Flooring.LINOLEUM, GREY, 0.0, 0.0, 0.0]]),
        np.zeros(shape, dtype=np.uint8), sky=GREY, lit=False,
    )  # fmt: skip
    side = np.zeros((*shape, 3))
    side[..., 0] = 1.0
    return scene._replace(floor_light=np.ones(shape), side_light=side)


def _with_disc(x: float, y: float, radius: float = 0.1) -> Construction:
    building = Construction()
    building.marks.append(FloorMark(Mark.DISC, x, y, radius, WHITE, gloss=0.0, disc_id=1))
    return building


@pytest.mark.parametrize(
    ("pose", "tilt"), [((0.0, 0.0, 0.0), (0.0, 0.0)), ((1.3, -0.4, 2.1), (0.04, -0.015))]
)
def test_disc_is_rendered_where_the_camera_projects_it(
    published_camera: Camera, pose: tuple[float, ...], tilt: tuple[float, float]
) -> None:
    camera = tilted_camera(published_camera, tilt)
    robot_xy = np.array([0.35, -1.6])
    world_xy = (planar_transform(*pose) @ [*robot_xy, 0.0, 1.0])[:2]
    np.testing.assert_allclose(disc_in_robot(pose, world_xy), robot_xy, atol=1e-12)
    light = render_light(_scene(_with_disc(*world_xy)), camera, np.array(pose, dtype=np.float64))
    expected = render_disc(camera, robot_xy, 0.1, 1.0, 0.0)
    # The field's pixels are as high as a line of the full frame and half of both its neighbours.
    lines = light.radiance.astype(np.float64)
    field = 0.5 * lines[::2] + 0.25 * (lines[1::2] + np.roll(lines[1::2], 1, axis=0))
    crop = field[expected.window]
    # The disc's surface carries a faint grain, which clipping takes away.
    share = np.clip((crop - GREY) / (0.9 * WHITE - GREY), 0.0, 1.0)
    # Pixels across the outline have 12 rays.
    assert np.abs(centroid(share) - centroid(expected.grey)).max() < 0.03
    assert share.sum() == pytest.approx(expected.grey.sum(), rel=0.05)


def test_upright_edge_is_rendered_where_the_camera_projects_it(published_camera: Camera) -> None:
    building = Construction()
    corner = np.array([-0.7, -3.0])
    building.upright(corner, corner - np.array([3.0, 0.0]), 0.0, 2.5, Look(albedo=0.9))
    light = render_light(_scene(building), published_camera, np.zeros(3))
    heights = np.linspace(0.7, 2.0, 12)
    uv = published_camera.project_robot(np.column_stack([np.tile(corner, (12, 1)), heights]))
    uv = uv[(uv[:, 1] > 1.0) & (uv[:, 1] < 286.0)]
    assert len(uv) >= 6
    for u, v in uv:
        # The albedo's grain is weak: half way between both sides lies the edge.
        row = light.radiance[round(2.0 * v), round(u) - 12 : round(u) + 13].astype(np.float64)
        bright = row[:6].mean(), row[-6:].mean()
        share = (row - bright[0]) / (bright[1] - bright[0])
        position = round(u) - 12 + np.sum(1.0 - share) - 0.5
        assert abs(position - u) < 0.35
    # The wall covers what lies to the right of the edge.
    assert light.radiance[round(2.0 * uv[3, 1]), round(uv[3, 0]) + 8] > 0.4


def test_depth_is_the_distance_along_the_axis(published_camera: Camera) -> None:
    light = render_light(_scene(Construction()), published_camera, np.array([0.5, 0.2, 0.8]))
    for u, v in [(100, 200), (384, 144), (700, 250)]:
        floor = published_camera.floor_from_pixel([float(u), float(v)])
        depth = published_camera.robot_to_camera([*floor, 0.0])[2]
        assert light.depth[2 * v, u] == pytest.approx(depth, rel=1e-5)


def test_nearest_of_random_rectangles_is_found() -> None:
    rng = np.random.default_rng(3)
    building = Construction()
    for _ in range(300):
        a = rng.uniform(-8.0, 8.0, 2)
        b = a + rng.uniform(-1.5, 1.5, 2)
        building.upright(a, b, 0.0, float(rng.uniform(0.5, 2.5)), Look())
        building.level(a, np.array([0.7, 0.2]), np.array([-0.2, 0.7]), 0.8, Look())
    scene = _scene(building)
    hits = 0
    for _ in range(400):
        origin = np.array([*rng.uniform(-9.0, 9.0, 2), rng.uniform(0.1, 2.0)])
        direction = rng.standard_normal(3) * [1.0, 1.0, 0.2]
        q = scene.quads
        with np.errstate(divide="ignore"):
            t = (q[:, 3] - q[:, :3] @ origin) / (q[:, :3] @ direction)
        point = origin + t[:, None] * direction
        s = (q[:, 4:7] * point).sum(axis=1) - q[:, 7]
        r = (q[:, 8:11] * point).sum(axis=1) - q[:, 11]
        met = (t > 1e-6) & (t < 50.0) & (s >= 0) & (s <= 1) & (r >= 0) & (r <= 1)
        (x, y, z), (dx, dy, dz) = origin, direction
        found, distance = nearest_quad(scene, x, y, z, dx, dy, dz, 50.0, NOTHING)
        if not met.any():
            assert found == -1
            continue
        hits += 1
        assert distance == pytest.approx(t[met].min(), rel=1e-9)
        assert t[found] == pytest.approx(distance, rel=1e-9)
    assert hits > 100


def test_points_behind_a_box_are_hidden() -> None:
    building = Construction()
    building.box(np.array([0.0, -2.0]), 0.6, 0.4, 0.0, 1.0, Look(), "box")
    eye = np.array([0.0, 0.0, 1.5])
    # From 1.5 m the upper rear edge (2.2 m off) shades the floor up to 6.6 m.
    points = np.array([[0, -1.7], [0, -3.0], [0, -6.5], [0, -6.8], [0.5, -2.2]])
    points = np.column_stack([points, np.full(5, 1e-4)])
    visible = points_visible(_scene(building), eye, points, 0.01)
    assert visible.tolist() == [True, False, False, True, True]


def test_turning_smears_sideways_by_the_angle(published_camera: Camera) -> None:
    scene = _scene(_with_disc(0.0, -1.6))
    light = render_light(scene, published_camera, np.zeros(3))
    turned = np.array([0.0, 0.0, 0.02])
    blurred = smeared(light, published_camera, np.zeros(3), turned)
    before = published_camera.project_floor(disc_in_robot(-turned, [0.0, -1.6]))
    after = published_camera.project_floor(disc_in_robot(turned, [0.0, -1.6]))
    way = abs(before[0] - after[0])
    assert way > 8.0
    share, still = (
        np.clip((x.astype(np.float64) - GREY) / (WHITE - GREY), 0.0, 1.0)
        for x in (blurred, light.radiance)
    )
    line = round(2.0 * published_camera.project_floor([0.0, -1.6])[1])
    profile = share[line]
    # Convolving a plateau with a box of the way's width stretches its foot by that width.
    width = float((profile > 0.03).sum() - (still[line] > 0.03).sum())
    assert width == pytest.approx(way, abs=3.0)
    assert profile.sum() == pytest.approx(still[line].sum(), rel=0.03)
    np.testing.assert_allclose(centroid(share), centroid(still), atol=0.3)


def test_standing_still_smears_nothing(published_camera: Camera) -> None:
    light = render_light(_scene(_with_disc(0.3, -1.5)), published_camera, np.zeros(3))
    same = smeared(light, published_camera, np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(same, light.radiance, atol=1e-3)
    assert isinstance(light, Light)
