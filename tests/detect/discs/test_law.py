"""The published detector against its law, written down slowly from the text of the law."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from camera import Camera
from detect.circles import CircleDetections, detect_circles, disc_shape
from detect.discs.candidates import suppress_published
from detect.settings import PUBLISHED
from lut import DiscTable, build_disc_table
from tests.detect.painted_floor import PaintedFloor
from tools.benchmark.material import scaled_camera

FloatArray = NDArray[np.float64]

RADIUS = 0.1
PLACES = np.array([(0.0, -1.2), (-0.8, -1.6), (0.7, -2.1), (-0.2, -2.6), (0.45, -3.3)])


def projected(camera: Camera, floor_xy: FloatArray) -> FloatArray:
    """Pixels of floor points, the pose taken as a rigid motion."""
    point = np.concatenate([floor_xy, np.zeros_like(floor_xy[..., :1])], axis=-1)
    return camera.project((point - camera.centre) @ camera.rotation)


def sizes_down(camera: Camera, places: FloatArray) -> FloatArray:
    """(N,) the floor's length of one pixel down the image at (N, 2) places: |J_v|."""
    x, y = 1e-5 * np.eye(2)
    by_x = (projected(camera, places + x) - projected(camera, places - x)) / 2e-5
    by_y = (projected(camera, places + y) - projected(camera, places - y)) / 2e-5
    by_pixel = np.linalg.inv(np.stack([by_x, by_y], axis=-1))
    return np.asarray(np.linalg.norm(by_pixel[:, :, 1], axis=-1))


def pairs_in_row(camera: Camera, v: int) -> Iterator[tuple[int, FloatArray, NDArray[np.int64]]]:
    """Points 1 to 3: the columns in a row that are tested, their places, the pairs that count.

    A pair is that of (column, row) of both samples: (K, 2, 2).
    """
    columns = np.column_stack([np.arange(camera.width), np.full(camera.width, v)])
    places = camera.floor_from_pixel(columns.astype(float))
    on_floor = np.flatnonzero(np.isfinite(places).all(axis=1))
    sizes = sizes_down(camera, places[on_floor])
    near = sizes <= RADIUS / 2
    columns, sizes = on_floor[near], sizes[near]
    places = places[columns]
    angle = np.arange(16) * math.pi / 8
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def samples(radii: FloatArray) -> FloatArray:
        """(N, 16, 2, 2) pixels, of both radii in each direction."""
        offset = radii[..., None] * direction[:, None]
        return projected(camera, places[:, None, None] + offset)

    radii = np.full((len(columns), 16, 2), [0.8 * RADIUS, 1.2 * RADIUS])
    whole = np.floor(samples(radii) + 0.5)
    together = np.all(whole[:, :, 0] == whole[:, :, 1], axis=-1)
    radii += together[..., None] * sizes[:, None, None] * [-0.5, 0.5]
    seen = samples(radii)
    whole = np.floor(seen + 0.5)
    last = (camera.width - 1, camera.height - 1)
    inside = np.all((seen >= 0.0) & (whole <= last), axis=(2, 3))
    u = 0
    for column, place, size, pairs, count in zip(columns, places, sizes, whole, inside):
        if column >= u and count.sum() >= 13:
            yield int(column), place, pairs[count].astype(np.int64)
            u = column + math.ceil(0.4 * RADIUS / size)


def by_the_law(image: NDArray[np.uint8], camera: Camera) -> list[tuple[int, int, float]]:
    """Pixels and qualities of the discs."""
    accepted = []
    for v in range(camera.height):
        for u, place, pairs in pairs_in_row(camera, v):
            grey = image[pairs[..., 1], pairs[..., 0]].astype(float)
            contrast = grey[:, 0].mean() - grey[:, 1].mean()
            if abs(contrast) > 5.0 and 0.25 * contrast**2 / grey.var() > 0.6:
                accepted.append((u, v, 0.25 * contrast**2 / grey.var(), place))
    return [
        (u, v, quality)
        for u, v, quality, place in accepted
        if not any(
            other > quality and np.hypot(*(there - place)) < 2 * RADIUS
            for _, _, other, there in accepted
        )
    ]


@cache
def table_of(camera: Camera) -> DiscTable:
    return build_disc_table(camera, disc_shape(PUBLISHED))


def detect(image: NDArray[np.uint8], camera: Camera) -> CircleDetections:
    return detect_circles(image, camera, table_of(camera), PUBLISHED)


def test_detections_are_those_of_the_law(published_camera: Camera) -> None:
    camera = scaled_camera(published_camera, 0.75)
    floor = PaintedFloor(camera)
    for number, place in enumerate(PLACES):
        floor.disc(place, 190.0 if number % 2 else 50.0)
    image = floor.image(noise=6.0, seed=4)
    found = detect(image, camera)
    expected = by_the_law(image, camera)
    assert len(expected) == len(PLACES)
    assert found.pixels.tolist() == [[u, v] for u, v, _ in expected]
    np.testing.assert_allclose(found.quality, [q for _, _, q in expected], rtol=1e-12)


def test_tested_centres_and_their_pairs_are_those_of_the_law(published_camera: Camera) -> None:
    """Near the border, at the far limit, and between."""
    camera = published_camera
    table = table_of(camera)
    assert int(table.usable.sum()) == 43_404
    for v in (94, 116, 276):
        expected = {u: len(pairs) for u, _, pairs in pairs_in_row(camera, v)}
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
    kept = np.flatnonzero(suppress_published(pixels, quality, floor_xy, 2.5)).tolist()
    expected: list[int] = []
    for k in range(count):
        near = [j for j in range(count) if j != k and np.hypot(*(pixels[j] - pixels[k])) < 2.5]
        if not any(
            quality[j] > quality[k] or (quality[j] == quality[k] and j in expected) for j in near
        ):
            expected.append(k)
    assert kept == expected
