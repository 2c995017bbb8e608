"""Rendered floors with disturbed discs: shares as asked for, places as stated, the same again."""

from __future__ import annotations

import numpy as np
import pytest

from camera import Camera
from detect.circles import detect_circles, disc_table
from detect.settings import CircleSettings
from lut.outlines import floor_positions
from tools.evaluation.disturbances import (
    DISTURBANCES,
    LOOK_ALIKES,
    Surroundings,
    _size_for,
    look_alike,
    with_disc,
)
from tools.evaluation.disturbed import BLURRED, BORDER, FloorScene, measure_families, render_scene

SETTINGS = CircleSettings(polarity="light", tilt_sigma_deg=0.0)


@pytest.fixture(scope="module")
def scene(published_camera: Camera) -> FloorScene:
    return FloorScene(published_camera, 0.1, np.random.default_rng(1))


def bare_disc() -> Surroundings:
    """A light disc on a dark floor, at a fiftieth of its radius."""
    at = np.linspace(-5.0, 5.0, 501)
    offset = np.stack(np.meshgrid(at, at), axis=-1)
    grey = np.where(np.hypot(offset[..., 0], offset[..., 1]) < 1.0, 200.0, 80.0)
    return Surroundings.of(grey, offset, 0.3)


@pytest.mark.parametrize("kind", DISTURBANCES)
@pytest.mark.parametrize("share", [0.1, 0.4])
def test_a_share_of_the_rim_is_disturbed(kind: str, share: float) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    for seed in range(4):
        distance = DISTURBANCES[kind].shape(np.random.default_rng(seed))
        covered = distance(np.cos(angle), np.sin(angle), _size_for(distance, share)) > 0.0
        assert np.mean(covered) == pytest.approx(share, abs=0.02)
        about = bare_disc()
        grey = DISTURBANCES[kind](about, share, np.random.default_rng(seed))
        assert grey.shape == about.grey.shape
        assert np.abs(grey - about.grey).max() > 10.0


@pytest.mark.parametrize("kind", LOOK_ALIKES)
def test_a_look_alike_leaves_nothing_of_the_disc(kind: str) -> None:
    about = bare_disc()
    grey = look_alike(about, kind, np.random.default_rng(3))
    assert np.abs(grey - about.grey).max() > 10.0
    with pytest.raises(ValueError, match="no such thing"):
        look_alike(about, "no such thing", np.random.default_rng(3))


def test_scenes_are_the_same_again_and_discs_where_they_are_stated(scene: FloorScene) -> None:
    image, places = render_scene(scene, "tape", 0.0, np.random.default_rng(5))
    again, _ = render_scene(scene, "tape", 0.0, np.random.default_rng(5))
    assert len(places) > 0
    np.testing.assert_array_equal(image, again)
    for place in places:
        u, v = np.rint(scene.camera.project_floor(place)).astype(int)
        rim = np.rint(scene.outline(place, 1.5)).astype(int)
        assert image[v, u] > image[rim[:, 1], rim[:, 0]].max() + 20


def test_a_disc_is_cut_by_the_border_as_asked(scene: FloorScene) -> None:
    for seed in range(3):
        _, places = render_scene(scene, BORDER, 0.3, np.random.default_rng(seed))
        for place in places:
            assert 1.0 - scene.seen_share(place) == pytest.approx(0.3, abs=0.06)


def test_a_disc_that_is_painted_into_an_image_is_found_there(scene: FloorScene) -> None:
    camera, rng = scene.camera, np.random.default_rng(4)
    image = scene.exposed(scene.floors["tiles"], (0.0, 0.7), rng)
    places = np.array([(-0.4, -1.5), (0.5, -2.0), (0.0, -3.0)])
    floor_xy = floor_positions(camera).astype(np.float32)
    for place in places:
        image = with_disc(image, floor_xy, place, 0.1, rng)
    found = detect_circles(image, camera, disc_table(camera, SETTINGS), SETTINGS)
    off = np.linalg.norm(found.floor_xy[None] - places[:, None], axis=-1)
    assert len(found) == 3
    assert (off.min(axis=1) < 0.02).all()


@pytest.mark.long
def test_the_figures_of_every_family(published_camera: Camera) -> None:
    """A few discs each; the documentation's table has a hundred."""
    results = list(measure_families(published_camera, SETTINGS, discs=4, shares=(0.2,), seed=1))
    kinds = [kind for kind, _, _ in results]
    assert kinds == [*DISTURBANCES, BORDER, *BLURRED, *LOOK_ALIKES]
    discs = [tally for kind, _, tally in results if kind not in LOOK_ALIKES]
    assert sum(t.found for t in discs) >= 0.97 * sum(t.shown for t in discs)
    assert all(tally.rms_px < 1.0 for tally in discs)
    assert sum(tally.elsewhere for _, _, tally in results) <= 1
