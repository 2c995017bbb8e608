"""Rows that come back into the image: known leans, missing and doubled rows, frames not level."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from camera import Camera, camera_in
from detect.circles import CircleDetections
from detect.cli import main
from detect.comparison.compare import compare_frames
from detect.comparison.result import DiscComparison
from detect.levelling import levelled
from detect.options import CompareOptions
from detect.projection import DiscProjection, image_positions, level_positions
from detect.settings import CircleSettings
from redetect.landmarks import (
    CircleLandmark,
    Frame,
    FrameTilt,
    Step,
    circle_landmarks,
    format_frame,
    read_frames,
    write_frames,
)
from redetect.storage import write_whole
from tests.detect.commands import Captured, assert_refused
from tests.detect.comparison.formatting import format_text

FloatArray = NDArray[np.float64]

PITCH, ROLL = np.radians([-2.3, 0.7])


def frame(
    index: int,
    xy: FloatArray,
    by: tuple[float, float] | None = None,
    ids: int = 1,
    sigma_m: float = 0.02,
) -> Frame:
    count = len(xy)
    covariance = np.tile(sigma_m**2 * np.eye(2), (count, 1, 1))
    rows = circle_landmarks(xy, np.full(count, 0.9), covariance, np.full(count, ids))
    return Frame(Step(f"s.{index:04d}", *[0.0] * 9), rows, by)


def places(rng: np.random.Generator, count: int = 6) -> FloatArray:
    """Discs in view, no two within each other's image."""
    forward = np.linspace(1.0, 4.0, count)
    return np.column_stack([rng.uniform(-0.3, 0.3, count) * forward, -forward])


def leaning_run(
    camera: Camera, noise_px: float = 0.3, frames: int = 60, declared: bool = True
) -> tuple[list[Frame], list[Frame]]:
    """Raw rows, and the same levelled by a constant lean, with noise in the image."""
    rng = np.random.default_rng(4)
    raw, level = [], []
    for k in range(frames):
        xy = places(rng)
        pixels = camera.project_floor(xy) + rng.normal(0.0, noise_px, xy.shape)
        again = level_positions(camera, camera.floor_from_pixel(pixels), (PITCH, ROLL))
        raw.append(frame(k, xy))
        level.append(frame(k, again, (PITCH, ROLL) if declared else None))
    return raw, level


def compare(camera: Camera, raw: list[Frame], level: list[Frame]) -> DiscComparison:
    return compare_frames(raw, level, CompareOptions(), projection=DiscProjection(camera))


@given(
    st.lists(st.tuples(st.floats(60, 700), st.floats(110, 280)), min_size=1, max_size=5),
    st.floats(-0.08, 0.08),
    st.floats(-0.08, 0.08),
)
def test_pixels_come_back_from_detection_and_levelling(
    published_camera: Camera, pixels: list[tuple[float, float]], pitch: float, roll: float
) -> None:
    seen = np.array(pixels)
    raw = published_camera.floor_from_pixel(seen)
    level = level_positions(published_camera, raw, (pitch, roll))
    known = np.isfinite(level).all(axis=1) & (np.linalg.norm(level, axis=1) < 100.0)
    back = image_positions(published_camera, level, (pitch, roll))
    np.testing.assert_allclose(back[known], seen[known], atol=1e-6)


@pytest.mark.parametrize(("whole", "said"), [(True, "at whole pixels"), (False, "too small if")])
def test_rows_at_whole_pixels_do_not_tell_of_covariances(
    published_camera: Camera, whole: bool, said: str
) -> None:
    """The published detector's rows have errors of a pixel, which are not those of other rows."""
    rng = np.random.default_rng(8)
    truth, rounded = [], []
    for k in range(20):
        xy = places(rng)
        pixels = published_camera.project_floor(xy)
        pixels = np.rint(pixels) if whole else pixels + rng.uniform(-0.5, 0.5, xy.shape)
        truth.append(frame(k, xy, sigma_m=0.002))
        rounded.append(frame(k, published_camera.floor_from_pixel(pixels).round(6)))
    result = compare(published_camera, rounded, truth)
    assert result.reference_whole_pixels == whole
    assert said in result.sentences()[-1]


def test_files_keep_what_levelled_a_frame(published_camera: Camera, tmp_path: Path) -> None:
    """The tilt that was applied, and pixels to the file's six digits."""
    pixels = np.array([[300.25, 250.5], [420.75, 180.125], [100.0, 160.0]])
    raw = published_camera.floor_from_pixel(pixels)
    count = len(raw)
    found = CircleDetections(
        np.rint(pixels).astype(np.int64),
        raw,
        np.tile(1e-4 * np.eye(2), (count, 1, 1)),
        np.full(count, 0.9),
        np.ones(count),
    )
    tilt = FrameTilt("s.0000", 0.031, -0.017, 1e-4, 0.0, 1e-4, 9)
    discs = levelled(found, published_camera, tilt)
    assert discs.levelled_by == (tilt.pitch, tilt.roll)
    path = tmp_path / "detected.circles"
    write_frames(path, [frame(0, discs.floor_xy, discs.levelled_by), frame(1, raw)])
    first, second = read_frames(path)
    assert first.levelled_by == pytest.approx(discs.levelled_by, abs=1e-9)
    assert second.levelled_by is None
    xy = np.array([(row.px, row.py) for row in first.circles])
    back = image_positions(published_camera, xy, first.levelled_by)
    np.testing.assert_allclose(back, pixels, atol=2e-3)
    with write_whole(tmp_path / "again.circles", overwrite=False) as stream:
        for again in (first, second):
            stream.write(format_frame(again))
    assert (tmp_path / "again.circles").read_bytes() == path.read_bytes()


def test_a_lean_is_a_difference_on_the_floor_not_missed_rows(published_camera: Camera) -> None:
    found = compare(published_camera, *leaning_run(published_camera))
    assert found.in_image
    assert found.recall == found.precision == 1.0
    assert found.image_median_px == pytest.approx(0.35, abs=0.1)
    assert np.median(np.linalg.norm(found.pairs.as_written, axis=1)) > 0.1
    assert found.error_median_m is not None
    assert found.error_median_m < 0.02
    far = next(part for part in found.bins if part.from_m == 3.0)
    assert far.as_written.along_m is not None
    assert far.as_written.along_m > 0.2
    assert far.alike is not None
    assert abs(far.alike.along_m or 0.0) < 0.02
    text = " ".join(format_text(found).split())
    assert "reference levelled 0 detected levelled 60" in text
    assert "the same levelled alike" in text
    assert json.loads(found.to_json())["pairs"] == found.matched


def test_rows_levelled_by_other_tilts_are_levelled_alike(published_camera: Camera) -> None:
    xy = places(np.random.default_rng(6))
    by_one, by_other = (PITCH, ROLL), (0.01, 0.02)
    sides = [
        [frame(0, level_positions(published_camera, xy, tilt), tilt)] for tilt in (by_one, by_other)
    ]
    found = compare(published_camera, *sides)
    assert found.matched == len(xy)
    assert found.error_95_m == pytest.approx(0.0, abs=1e-6)
    backwards = compare(published_camera, sides[0], [frame(0, xy)])
    assert backwards.error_95_m == pytest.approx(0.0, abs=1e-6)


def test_frames_without_a_tilt_and_with_other_rows(published_camera: Camera) -> None:
    raw, level = leaning_run(published_camera, noise_px=0.0)
    # Not levelled, since no tilt was known; one row not found; one found twice.
    level[0] = frame(0, np.array([(r.px, r.py) for r in raw[0].circles]))
    level[1] = Frame(level[1].step, level[1].landmarks[1:], level[1].levelled_by)
    level[2] = Frame(
        level[2].step, (*level[2].landmarks, level[2].landmarks[0]), level[2].levelled_by
    )
    found = compare(published_camera, raw, level)
    assert (found.missed, found.extra) == (1, 1)
    assert found.detected_levelled == 59


def test_level_truth_is_seen_through_the_tilt_of_what_was_detected(
    published_camera: Camera,
) -> None:
    _, level = leaning_run(published_camera)
    truth = [Frame(f.step, f.landmarks) for f in level]
    projection = DiscProjection(published_camera, reference_level=True)
    found = compare_frames(truth, level, CompareOptions(), projection=projection)
    assert found.recall == 1.0
    assert found.image_95_px == pytest.approx(0.0, abs=1e-9)
    # True rows need not say that they are level.
    unsaid = compare(published_camera, truth, level)
    assert unsaid.reference_level
    assert unsaid.recall == 1.0
    assert unsaid.error_95_m == pytest.approx(0.0, abs=1e-9)
    fewer = [replace(truth[0], landmarks=truth[0].landmarks[1:]), *truth[1:]]
    projection = DiscProjection(published_camera)
    found = compare_frames(fewer, level, projection=projection, unlisted=iter(truth))
    assert (found.reference_level, found.set_aside, found.extra) == (True, 1, 0)
    raw, level = leaning_run(published_camera)
    assert not compare(published_camera, raw, level).reference_level


@pytest.mark.parametrize(("tilt_deg", "sigma_deg"), [(0.7, None), (2.5, 1.0)])
def test_rows_that_are_not_levelled_match_level_truth(
    published_camera: Camera, tilt_deg: float, sigma_deg: float | None
) -> None:
    camera = replace(
        published_camera, width=2304, height=1728, scale_x=1394.0, scale_y=1394.0,
        offset_x=1152.0, offset_y=864.0,
    )  # fmt: skip
    rng, truth, seen = np.random.default_rng(3), [], []
    for k in range(20):
        xy = places(rng)
        by = tuple(np.radians(rng.uniform(-tilt_deg, tilt_deg, 2)))
        truth.append(frame(k, xy))
        seen.append(frame(k, camera.floor_from_pixel(image_positions(camera, xy, by))))

    projection = DiscProjection(
        camera, CircleSettings(tilt_sigma_deg=sigma_deg), reference_level=True
    )
    found = compare_frames(truth, seen, projection=projection)

    assert (found.recall, found.extra) == (1.0, 0)
    assert "not corrected for the robot's tilt" in found.sentences()[2]
    on_one_tilt = compare_frames(truth, truth, projection=DiscProjection(camera))
    assert "tilt" not in on_one_tilt.sentences()[2]


def test_a_far_disc_is_the_same_within_three_pixels(published_camera: Camera) -> None:
    far = np.array([[0.0, -6.0]])
    pixel = published_camera.project_floor(far)

    def matched(rows: float, columns: float = 0.0) -> int:
        moved = published_camera.floor_from_pixel(pixel + np.array([columns, rows]))
        return compare(published_camera, [frame(0, far)], [frame(0, moved)]).matched

    assert [matched(2.9), matched(3.1), matched(0.0, 6.0), matched(0.0, 12.0)] == [1, 0, 1, 0]


def test_rows_that_are_levelled_alike_have_no_second_figures(published_camera: Camera) -> None:
    xy = np.array([[0.1, -2.0], [0.1, -3.0]])
    same = compare(published_camera, [frame(0, xy)], [frame(0, xy)])
    assert {part.alike for part in same.bins} == {None}
    nothing = compare(published_camera, [frame(0, xy)], [frame(0, xy[:0])])
    assert nothing.matched == 0
    json.loads(nothing.to_json())


def test_without_a_calibration_the_floor_is_compared(tmp_path: Path, capsys: Captured) -> None:
    row = CircleLandmark(0.0, -1.0, 0.9, 1e-4, 0.0, 1e-4, (1,))
    for name in ("map.circles", "detected.circles"):
        write_frames(tmp_path / name, [Frame(Step("s.0000", *[0.0] * 9), (row,))])
    taken = ["--json", str(tmp_path / "map.circles")]
    assert_refused(["compare", str(tmp_path), *taken], tmp_path, "exists already", capsys)
    assert main(["compare", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    assert "no calibration: positions are compared on the floor" in told
    assert main(["compare", str(tmp_path), "--gate-m", "0.2"]) == 0
    assert "no calibration" not in capsys.readouterr().out


def test_real_rows_levelled_or_not_are_the_same_rows(shared_data: Path, tmp_path: Path) -> None:
    """All shipped rows, levelled by any tilt, are found again."""
    folder = shared_data / "dlr" / "e"
    camera = camera_in(folder)
    assert camera is not None
    raw = list(read_frames(folder / "map.circles"))[:200]
    level = []
    for index, one in enumerate(raw):
        xy = np.array([(r.px, r.py) for r in one.circles]).reshape(-1, 2)
        level.append(
            Frame(one.step, frame(index, level_positions(camera, xy, (PITCH, ROLL))).landmarks,
                  (PITCH, ROLL))
        )  # fmt: skip
    found = compare(camera, raw, level)
    assert found.recall == found.precision == 1.0
    assert found.image_95_px == pytest.approx(0.0, abs=1e-6)


def test_runs_without_a_common_image_are_an_empty_table(published_camera: Camera) -> None:
    result = compare(published_camera, [], [])
    assert result.columns() == {}
    assert "no discs" in str(result)
