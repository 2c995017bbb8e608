"""The camera against the published detections: positions and covariances to every printed digit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from camera import Camera
from detect.discs.positions import published_covariance
from redetect.landmarks import CircleLandmark, read_frames

# The report's printed rows of runs e and c, with the pixels that they come from.
PRINTED_ROWS = [
    ((437, 151), "-0.302229 -2.66488", "0.00169895 0.000127857 0.00293675"),
    ((217, 174), "1.0116 -2.15034", "0.00175878 -0.000250459 0.00238307"),
    ((585, 199), "-0.96104 -1.69011", "0.00171485 0.000154117 0.00202176"),
    ((411, 124), "-0.176652 -3.54651", "0.00174355 0.000174856 0.00500673"),
    ((439, 156), "-0.302829 -2.53982", "0.0016918 0.000113261 0.00275804"),
    ((210, 181), "1.01062 -2.01621", "0.00174479 -0.00021812 0.00226073"),
    ((293, 144), "0.67972 -2.87676", "0.00176143 -0.000314459 0.00334762"),
]


@pytest.mark.parametrize(("pixel", "position", "spread"), PRINTED_ROWS)
def test_printed_rows_come_out_in_all_digits(
    published_camera: Camera, pixel: tuple[int, int], position: str, spread: str
) -> None:
    px, py = published_camera.floor_from_pixel(pixel)
    assert f"{px:g} {py:g}" == position
    c = published_covariance(published_camera, np.array(pixel))
    assert f"{c[0, 0]:g} {c[0, 1]:g} {c[1, 1]:g}" == spread


@pytest.fixture(scope="module")
def shipped_rows(shared_data: Path) -> list[CircleLandmark]:
    """All discs of run e as the data set ships them."""
    frames = read_frames(shared_data / "dlr" / "map.circles")
    rows = [circle for frame in frames for circle in frame.circles]
    assert len(rows) == 14745
    return rows


def test_all_shipped_positions_come_out_in_all_digits(
    published_camera: Camera, shipped_rows: list[CircleLandmark]
) -> None:
    shipped = np.array([(row.px, row.py) for row in shipped_rows])
    seen = published_camera.project_floor(shipped)
    pixels = np.rint(seen)
    # Far out the six printed digits are worth a thousandth of a pixel.
    assert np.abs(seen - pixels).max() < 2e-3
    again = published_camera.floor_from_pixel(pixels)
    differing = [
        (tuple(a), tuple(b))
        for a, b in zip(again, shipped)
        if (f"{a[0]:g}", f"{a[1]:g}") != (f"{b[0]:g}", f"{b[1]:g}")
    ]
    assert differing == []


def test_all_shipped_covariances_come_out_in_all_digits(
    published_camera: Camera, shipped_rows: list[CircleLandmark]
) -> None:
    shipped = np.array([(row.px, row.py) for row in shipped_rows])
    entries = np.array([(row.cxx, row.cxy, row.cyy) for row in shipped_rows])
    c = published_covariance(published_camera, np.rint(published_camera.project_floor(shipped)))
    again = np.stack([c[:, 0, 0], c[:, 0, 1], c[:, 1, 1]], axis=-1)
    assert [f"{x:g}" for x in again.ravel()] == [f"{x:g}" for x in entries.ravel()]
