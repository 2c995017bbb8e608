"""The published detector against its law, written down slowly from the text of the law."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from camera import Camera
from detect.circles import CircleDetections, detect_circles, disc_shape
from detect.discs.candidates import alone_published
from detect.settings import PUBLISHED
from lut import DiscTable, build_disc_table
from tests.detect.painted_floor import PaintedFloor
from tools.benchmark.material import scaled_camera

FloatArray = NDArray[np.float64]

PLACES = np.array([(0.0, -1.2), (-0.8, -1.6), (0.7, -2.1), (-0.2, -2.6), (0.45, -3.3)])


def projected(camera: Camera, floor_xy: FloatArray) -> FloatArray:
    """Pixels of floor points, the pose taken as a rigid motion."""
    point = np.concatenate([floor_xy, np.zeros_like(floor_xy[..., :1])], axis=-1)
    return camera.project((point - camera.centre) @ camera.rotation)


def size_down(camera: Camera, place: FloatArray) -> float:
    """The floor's length of one pixel down the image: |J_v|."""
    steps = 1e-5 * np.eye(2)
    by_floor = (projected(camera, place + steps) - projected(camera, place - steps)).T / 2e-5
    return float(np.hypot(*np.linalg.inv(by_floor)[:, 1]))


def pairs_of(
    camera: Camera, place: FloatArray, size: float, radius: float
) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Points 1 to 3: the pairs of samples that count, as (row, column) of both."""
    angle = np.arange(16) * math.pi / 8
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    radii = np.full((16, 2), [0.8 * radius, 1.2 * radius])
    seen = projected(camera, place + radii[:, :, None] * direction[:, None])
    together = np.all(np.floor(seen[:, 0] + 0.5) == np.floor(seen[:, 1] + 0.5), axis=-1)
    radii[together] += [-size / 2, size / 2]
    seen = projected(camera, place + radii[:, :, None] * direction[:, None])
    whole = np.floor(seen + 0.5)
    last = (camera.width - 1, camera.height - 1)
    inside = np.all((seen >= 0.0) & (whole <= last), axis=(1, 2))
    return [((v1, u1), (v2, u2)) for (u1, v1), (u2, v2) in whole[inside].astype(int).tolist()]


def by_the_law(
    image: NDArray[np.uint8], camera: Camera, rows: range, radius: float = 0.1
) -> list[tuple[int, int, float]]:
    """Pixels and qualities of the discs whose pixels lie in some rows of the image."""
    accepted = []
    for v in rows:
        u = 0
        while u < camera.width:
            place = camera.floor_from_pixel(np.array([u, v], float))
            size = size_down(camera, place) if np.isfinite(place).all() else math.inf
            pairs = pairs_of(camera, place, size, radius) if size <= radius / 2 else []
            if len(pairs) < 13:
                u += 1
                continue
            grey = np.array([[image[inner], image[outer]] for inner, outer in pairs], float)
            contrast = grey[:, 0].mean() - grey[:, 1].mean()
            if abs(contrast) > 5.0 and 0.25 * contrast**2 / grey.var() > 0.6:
                accepted.append((u, v, 0.25 * contrast**2 / grey.var(), place))
            u += math.ceil(0.4 * radius / size)
    return [
        (u, v, quality)
        for u, v, quality, place in accepted
        if not any(
            other > quality and np.hypot(*(there - place)) < 2 * radius
            for _, _, other, there in accepted
        )
    ]


@cache
def table_of(camera: Camera) -> DiscTable:
    return build_disc_table(camera, disc_shape(PUBLISHED))


def detect(image: NDArray[np.uint8], camera: Camera) -> CircleDetections:
    return detect_circles(image, camera, table_of(camera), PUBLISHED)


def test_detections_are_those_of_the_law(published_camera: Camera) -> None:
    # A ninth of the pixels: the slow law takes its time.
    camera = scaled_camera(published_camera, 1 / 3)
    floor = PaintedFloor(camera)
    for number, place in enumerate(PLACES):
        floor.disc(place, 190.0 if number % 2 else 50.0)
    image = floor.image(noise=6.0, seed=4)
    found = detect(image, camera)
    expected = by_the_law(image, camera, range(camera.height))
    assert len(expected) >= 4
    assert found.pixels.tolist() == [[u, v] for u, v, _ in expected]
    np.testing.assert_allclose(found.quality, [q for _, _, q in expected], rtol=1e-12)


def test_tested_centres_and_their_pairs_are_those_of_the_law(published_camera: Camera) -> None:
    """Near the border, at the far limit, and between."""
    camera = published_camera
    table = table_of(camera)
    assert int(table.usable.sum()) == 43_404
    for v in (94, 116, 276):
        u, expected = 0, {}
        while u < camera.width:
            place = camera.floor_from_pixel(np.array([u, v], float))
            size = size_down(camera, place) if np.isfinite(place).all() else math.inf
            count = len(pairs_of(camera, place, size, 0.1)) if size <= 0.05 else 0
            if count >= 13:
                expected[u] = count
                u += math.ceil(0.04 / size)
            else:
                u += 1
        assert np.flatnonzero(table.usable[v]).tolist() == list(expected)
        inside = table.samples[table.pixels[:, 1] == v] < camera.width * camera.height
        np.testing.assert_array_equal(inside.sum(axis=1).T, [list(expected.values())] * 2)


@settings(max_examples=8)
@given(
    grey=st.integers(60, 255),
    shift=st.floats(-0.1, 0.1),
    dark=st.booleans(),
    step=st.integers(6, 60),
)
def test_saturated_discs_are_neither_lost_nor_doubled(
    published_camera: Camera, grey: int, shift: float, dark: bool, step: int
) -> None:
    """Without noise many pixels of a disc have the quality 1."""
    floor = PaintedFloor(published_camera, floor=float(grey - step if not dark else grey))
    places = PLACES[:3] + np.array([shift, 0.0])
    for place in places:
        floor.disc(place, float(grey if not dark else grey - step))
    found = detect(floor.image(noise=0.0), published_camera)
    distance = np.hypot(*(found.floor_xy[:, None] - places).transpose(2, 0, 1))
    assert len(found) == len(places)
    assert distance.min(axis=0).max() < 0.06
    assert len(set(distance.argmin(axis=1).tolist())) == len(places)


def test_contrast_must_exceed_five_grey_levels(published_camera: Camera) -> None:
    for step, count in ((5.0, 0), (6.0, 1)):
        floor = PaintedFloor(published_camera, floor=100.0)
        floor.disc(PLACES[0], 100.0 + step)
        assert len(detect(floor.image(noise=0.0), published_camera)) == count


@given(st.data())
def test_what_is_alone_is_so_by_definition(data: st.DataObject) -> None:
    count = data.draw(st.integers(0, 30))
    pixels = np.array(
        data.draw(
            st.lists(
                st.tuples(st.integers(0, 9), st.integers(0, 9)),
                min_size=count,
                max_size=count,
                unique=True,
            )
        ),
        np.int64,
    ).reshape(-1, 2)
    quality = np.array(
        data.draw(st.lists(st.sampled_from([0.5, 0.7, 0.8]), min_size=count, max_size=count))
    ).reshape(-1)
    v, u = np.mgrid[0:10, 0:10].astype(np.float32)
    floor_xy = np.stack([u, v], axis=-1)
    kept = np.flatnonzero(alone_published(pixels, quality, floor_xy, 2.5)).tolist()
    expected: list[int] = []
    for k in range(count):
        near = [j for j in range(count) if j != k and np.hypot(*(pixels[j] - pixels[k])) < 2.5]
        if not any(
            quality[j] > quality[k] or (quality[j] == quality[k] and j in expected) for j in near
        ):
            expected.append(k)
    assert kept == expected
