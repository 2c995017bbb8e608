"""The plain gather finds what the detector's kernel finds, and what the definition says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from detect.circles import disc_shape, quality_of_centres
from detect.settings import REPORT, CircleSettings
from lut import build_disc_table, ring
from tools.benchmark.material import decode, scaled_camera
from tools.benchmark.plain_gather import gather_table, plain_quality_of_centres


def _noise(camera: Camera) -> NDArray[np.uint8]:
    rng = np.random.default_rng(5)
    return rng.integers(0, 256, (camera.height, camera.width), dtype=np.uint8)


@pytest.mark.parametrize("settings", [REPORT, CircleSettings()], ids=["published", "default"])
@pytest.mark.parametrize("picture", ["demo", "noise", "flat"])
def test_the_maps_are_those_of_the_detector(
    settings: CircleSettings, picture: str, published_camera: Camera, project_root: Path
) -> None:
    shape = disc_shape(settings)
    table = build_disc_table(published_camera, shape)
    if picture == "demo":
        image = decode(np.fromfile(project_root / "images/e/images/e.0010.jpg", np.uint8))
    elif picture == "noise":
        image = _noise(published_camera)
    else:
        image = np.full((published_camera.height, published_camera.width), 77, np.uint8)
    expected_quality, expected_contrast = quality_of_centres(image, table)
    gathered = gather_table(published_camera, shape, table)
    quality, contrast = plain_quality_of_centres(image, gathered)
    np.testing.assert_array_equal(quality, expected_quality)
    np.testing.assert_array_equal(contrast, expected_contrast)
    if picture != "flat":
        assert np.count_nonzero(quality) > 100_000


def test_the_quality_is_that_of_the_definition(published_camera: Camera) -> None:
    camera = scaled_camera(published_camera, 0.5)
    shape = disc_shape(REPORT)
    table = build_disc_table(camera, shape)
    gathered = gather_table(camera, shape, table)
    image = _noise(camera)
    quality, contrast = plain_quality_of_centres(image, gathered)

    centres = gathered.centres[:: len(gathered.centres) // 200]
    cut_off = 0
    for u, v in centres:
        floor_xy = camera.floor_from_pixel(np.array([u, v], float))
        voting = []
        for radius_m in (shape.inner_radius_m, shape.outer_radius_m):
            seen = camera.project_floor(floor_xy + ring(radius_m, shape.samples))
            column, row = np.floor(seen + 0.5).astype(int).T
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            voting.append(image[row[inside], column[inside]].astype(float))
            cut_off += int(np.count_nonzero(~inside))
        inner, outer = voting
        everything = np.concatenate(voting)
        share = np.array([len(inner), len(outer)]) / len(everything)
        means = np.array([inner.mean(), outer.mean()])
        between = float(share @ (means - everything.mean()) ** 2)
        assert quality[v, u] == pytest.approx(between / float(everything.var()), rel=1e-9)
        assert contrast[v, u] == pytest.approx(inner.mean() - outer.mean(), rel=1e-5, abs=1e-4)
    assert cut_off > 0  # samples outside the image were among them
