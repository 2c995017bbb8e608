"""The detector of verticals as a whole: rendered scenes, laws, and photographs with truth."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera import Camera, read_camera
from detect.drawing.frame import draw_rows, draw_tracks, track_pixels
from detect.errors import FrameError
from detect.line_settings import DEFAULT, PUBLISHED, REPORT, LineSettings
from detect.lines import ACCEPTED, JOINED, detect_lines
from detect.projection import DiscProjection, leaning_camera
from detect.row_files import ImageRows
from detect.sources.grey_images import decode_grey
from lut.verticals import build_vertical_table
from redetect.landmarks import Frame, LineLandmark, Step
from tests.detect.line_scene import (
    EDGES,
    Edge,
    edge_columns,
    mirrored,
    pinhole,
    render,
    tilt_of,
)
from tests.detect.verticals.stages import judge_tracks, line_starts, line_tracks, tracks_again
from tests.landmarks.rows import parse_record
from tests.pictures import read_grey
from tests.reference.verticals import compensated_bearings, inclinations, plane_normals

BARREL = (0.0, -0.1, 0.0, 0.0, 0.0)
CAMERA = pinhole(240, 160, 200.0, pitch_deg=10.0, roll_deg=1.0, coef=BARREL)
TABLE = build_vertical_table(CAMERA)


def scene(camera: Camera, edges: Sequence[Edge] = EDGES, seed: int = 0) -> np.ndarray:
    return render(camera, edges, noise=2.0, rng=np.random.default_rng(seed))


def truth(edges: Sequence[Edge] = EDGES) -> np.ndarray:
    return np.array([edge.bearing_rad for edge in edges])


@pytest.mark.parametrize("tilt_deg", [(0, 0), (2.3, 0), (-1.5, 2), (-4, 3), (6.5, -1)])
def test_bearings_and_tilt_of_a_tilted_camera(tilt_deg: tuple[float, float]) -> None:
    """Calibrated with one pose, standing in another: bearings are those of the world."""
    pitch, roll = np.radians(tilt_deg)
    found = detect_lines(scene(leaning_camera(CAMERA, (pitch, roll))), TABLE)
    np.testing.assert_allclose(found.lines.alpha_rad, truth(), atol=4e-4)
    np.testing.assert_allclose(tilt_of(found), (pitch, roll), atol=np.radians(0.08))
    assert found.tilt is not None
    assert found.tilt.lines == len(EDGES)
    # Uncompensated bearings are off by more.
    if max(np.abs(tilt_deg)) > 3.0:
        raw = compensated_bearings(plane_normals(found.lines.ends, CAMERA.rotation), None)
        assert np.abs(raw - truth()).max() > 1e-3


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("pitch_deg", [-33.0, 28.0, 40.0])
def test_cameras_that_do_not_see_the_horizon_see_verticals(
    pitch_deg: float, upside_down: bool
) -> None:
    roll_deg = 181.0 if upside_down else 1.0
    camera = pinhole(240, 160, 200.0, pitch_deg=pitch_deg, roll_deg=roll_deg, coef=BARREL)
    table = build_vertical_table(camera)
    assert abs(table.anchor_elevation_rad) > 0.1
    pitch, roll = np.radians([0.8, -0.5])
    found = detect_lines(scene(leaning_camera(camera, (pitch, roll))), table)
    order = np.argsort(-found.lines.alpha_rad)
    off = found.lines.alpha_rad[order] - truth()
    assert np.all(np.abs(off) < 3.0 * found.lines.sigma_rad[order])
    assert np.abs(off).max() < 2e-3
    assert found.tilt is not None
    deviation = np.sqrt(np.diag(found.tilt.covariance))
    # Seven lines may lean, as carpentry does, by more than they do here.
    assert np.all(deviation < np.radians(0.15))
    assert np.all(np.abs(tilt_of(found) - (pitch, roll)) < 4 * deviation)


def test_rows_hold_ends_beta_and_sigma() -> None:
    found = detect_lines(scene(leaning_camera(CAMERA, (0.02, -0.01))), TABLE)
    rows = found.landmarks()
    assert len(rows) == len(EDGES)
    for row, bearing in zip(rows, truth()):
        assert row.ids == (-1,)
        assert row.quality == 0.0
        ends = [row.xtop, row.ytop, row.xbottom, row.ybottom]
        normal = plane_normals(ends, CAMERA.rotation)
        assert row.beta == pytest.approx(float(inclinations(normal)), abs=1e-6)
        assert row.ytop < row.ybottom
        assert abs(row.alpha - bearing) < 3.0 * row.sigma
        # Ends lie on whole rows, and on the edge.
        pixels = CAMERA.distort(np.reshape(ends, (2, 2)))
        np.testing.assert_allclose(pixels[:, 1], np.rint(pixels[:, 1]), atol=0.02)
        expected = edge_columns(leaning_camera(CAMERA, (0.02, -0.01)), bearing, pixels[:, 1])
        np.testing.assert_allclose(pixels[:, 0], expected, atol=0.3)
    # Leftmost first.
    assert np.all(np.diff(found.lines.alpha_rad) < 0.0)


def test_published_convention_turns_the_other_way() -> None:
    image = scene(leaning_camera(CAMERA, (0.04, 0.0)))
    level = detect_lines(image, TABLE)
    other = detect_lines(image, TABLE, replace(DEFAULT, alpha="published"))
    assert level.tilt is not None
    np.testing.assert_allclose(other.lines.ends, level.lines.ends, atol=1e-9)
    np.testing.assert_allclose(
        other.lines.alpha_rad,
        compensated_bearings(
            plane_normals(level.lines.ends, CAMERA.rotation), level.tilt, published=True
        ),
        atol=1e-6,
    )
    assert np.abs(other.lines.alpha_rad - level.lines.alpha_rad).max() > 1e-3


@pytest.mark.parametrize(("preset", "margin"), [(REPORT, 22.0), (PUBLISHED, 23.0)])
def test_published_presets_keep_their_margins(preset: LineSettings, margin: float) -> None:
    camera = pinhole(240, 160, 200.0)
    table = build_vertical_table(camera)
    found = detect_lines(scene(camera), table, preset)
    np.testing.assert_allclose(found.lines.alpha_rad, truth(), atol=3e-3)
    rows = camera.distort(found.lines.ends.reshape(-1, 2, 2))[..., 1]
    np.testing.assert_allclose(rows, [[margin, 159.0 - margin]] * len(EDGES), atol=0.02)


@given(gain=st.floats(0.8, 2.0), offset=st.floats(0.0, 10.0))
@settings(max_examples=8)
def test_affine_brightness_does_not_matter(gain: float, offset: float) -> None:
    """Up to quantisation and what the regulariser adds."""
    plain = [Edge(edge.bearing_rad, 0.6 * edge.contrast) for edge in EDGES]
    changed = [Edge(edge.bearing_rad, gain * edge.contrast) for edge in plain]
    first = detect_lines(render(CAMERA, plain, grey=60.0), TABLE)
    second = detect_lines(render(CAMERA, changed, grey=60.0 * gain + offset), TABLE)
    np.testing.assert_allclose(second.lines.alpha_rad, first.lines.alpha_rad, atol=5e-4)


@pytest.mark.parametrize("seed", range(4))
def test_mirrored_image_and_camera_give_mirrored_rows(seed: int) -> None:
    image = scene(leaning_camera(CAMERA, (0.02, 0.01)), seed=seed)
    found = detect_lines(image, TABLE)
    other = detect_lines(
        np.ascontiguousarray(image[:, ::-1]), build_vertical_table(mirrored(CAMERA))
    )
    assert len(found) == len(EDGES)
    np.testing.assert_allclose(-other.lines.alpha_rad[::-1], found.lines.alpha_rad, atol=2e-5)
    np.testing.assert_allclose(other.lines.sigma_rad[::-1], found.lines.sigma_rad, rtol=2e-2)
    np.testing.assert_allclose(
        other.lines.ends[::-1], found.lines.ends * [-1.0, 1.0, -1.0, 1.0], atol=2e-4
    )
    np.testing.assert_allclose(tilt_of(other), tilt_of(found) * [1.0, -1.0], atol=1e-4)


@given(pitch=st.floats(-30.0, 30.0), roll=st.floats(-25.0, 25.0), seed=st.integers(0, 1000))
@settings(max_examples=25)
def test_no_row_outside_the_view(pitch: float, roll: float, seed: int) -> None:
    camera = pinhole(120, 90, 90.0, pitch_deg=pitch, roll_deg=roll, coef=BARREL)
    rng = np.random.default_rng(seed)
    image = np.repeat(rng.integers(0, 256, (1, 120)), 90, axis=0).astype(np.uint8)
    image = np.asarray(cv2.GaussianBlur(image, (5, 1), 1.0), np.uint8)
    table = build_vertical_table(camera)
    found = detect_lines(image, table)
    pixels = camera.distort(found.lines.ends.reshape(-1, 2, 2))
    assert np.all((pixels >= -0.5) & (pixels <= [119.5, 89.5]))
    assert all(np.isfinite(row.sigma) and row.sigma > 0.0 for row in found.landmarks())
    if not table.usable.any():
        assert len(found) == 0
        assert found.tilt is None


def test_two_lines_are_rows_without_a_tilt() -> None:
    found = detect_lines(scene(CAMERA, EDGES[:2]), TABLE)
    assert found.tilt is None
    np.testing.assert_allclose(found.lines.alpha_rad, truth(EDGES[:2]), atol=4e-4)


def test_leaning_edges_are_no_verticals() -> None:
    camera = pinhole(240, 160, 200.0)
    table = build_vertical_table(camera)
    image = scene(camera).astype(np.float64)
    columns, rows = np.meshgrid(np.arange(240), np.arange(160))
    image += np.where(columns > 165 + 0.12 * (rows - 80), -60.0, 0.0)
    found = detect_lines(np.clip(image, 0, 255).astype(np.uint8), table)
    np.testing.assert_allclose(found.lines.alpha_rad, truth(), atol=5e-4)
    assert abs(tilt_of(found)[1]) < np.radians(0.1)


def test_close_edges_are_joined_to_one_row() -> None:
    camera = pinhole(240, 160, 200.0)
    table = build_vertical_table(camera)
    bar = [Edge(0.003, 80.0), Edge(-0.006, -80.0)]
    apart = detect_lines(render(camera, bar, grey=80.0), table, replace(DEFAULT, join_px=1.0))
    joined = detect_lines(render(camera, bar, grey=80.0), table)
    assert (len(apart), len(joined)) == (2, 1)
    assert joined.lines.bounds.tolist() == [0, 2]
    assert sorted(joined.outcome[t] for t in joined.lines.members) == [ACCEPTED, JOINED]
    evidence = joined.judged.evidence[joined.lines.members]
    share, order = evidence / evidence.sum(), np.argsort(-evidence)
    assert apart.lines.bounds.tolist() == [0, 1, 2]
    sides = apart.lines.alpha_rad[np.argsort(-apart.judged.evidence[apart.lines.members])]
    mean = share[order] @ sides
    assert joined.lines.alpha_rad[0] == pytest.approx(mean, abs=1e-6)
    spread = share[order] @ (apart.lines.sigma_rad**2 + (sides - mean) ** 2)
    assert joined.lines.sigma_rad[0] == pytest.approx(np.sqrt(spread), rel=1e-3)


@pytest.mark.parametrize("bearing", [0.0, 0.45, -0.45])
def test_the_threshold_for_joining_is_an_angle(bearing: float) -> None:
    """Towards the border of an image, an angle is more pixels than in its middle."""
    camera = pinhole(320, 160, 300.0)
    table = build_vertical_table(camera)
    bar = [Edge(bearing + 0.01, 80.0), Edge(bearing - 0.01, -80.0)]
    image = render(camera, bar, grey=80.0)
    for threshold, lines in ((0.0196, 2), (0.0204, 1)):
        assert len(detect_lines(image, table, replace(DEFAULT, join_rad=threshold))) == lines


def test_rows_of_the_published_preset_join_lines_as_equals() -> None:
    """Two edges 8 px apart, one of them faint and short: the means of all that they have."""
    camera = pinhole(240, 160, 200.0)
    table = build_vertical_table(camera)
    image = render(camera, [Edge(0.02, 90.0), Edge(-0.02, 25.0)], grey=80.0)
    # The right edge ends above row 110; lines of the other remain.
    image[110:, 120:] = image[110:, 117:118]
    preset = replace(PUBLISHED, least_rows=30)
    apart = detect_lines(image, table, replace(preset, join_px=1.0))
    joined = detect_lines(image, table, preset)
    assert (len(apart), len(joined)) == (2, 1)
    rows = camera.distort(apart.lines.ends.reshape(-1, 2, 2))[..., 1]
    assert rows[0, 1] > rows[1, 1] + 10.0
    np.testing.assert_allclose(joined.lines.ends[0], apart.lines.ends.mean(axis=0), atol=1e-9)
    assert joined.lines.beta_rad[0] == pytest.approx(apart.lines.beta_rad.mean(), abs=1e-9)
    assert joined.lines.alpha_rad[0] == pytest.approx(apart.lines.alpha_rad.mean(), abs=1e-9)
    variance = np.mean(apart.lines.sigma_rad**2) + 0.25 * np.ptp(apart.lines.alpha_rad) ** 2
    assert joined.lines.sigma_rad[0] == pytest.approx(np.sqrt(variance), rel=1e-9)
    # A single line is known to the root of two pixels.
    assert apart.lines.sigma_rad[0] == pytest.approx(np.sqrt(2.0) / 200.0, rel=0.02)


def test_the_rows_that_the_report_prints(shared_data: Path) -> None:
    """Each of them by the published preset: ends, bearing, joined or not."""
    folder = shared_data / "dlr" / "e"
    camera = read_camera(folder / "e.cam")
    table = build_vertical_table(camera)
    printed = json.loads((shared_data / "published.json").read_text())["lines"]
    assert len(printed) == 8
    for entry in printed:
        path = folder / "images" / f"dlr-spatial_cognition-{entry['step']}.jpg"
        found = detect_lines(decode_grey(path.read_bytes(), path), table, PUBLISHED)
        row = parse_record(entry["row"])
        assert isinstance(row, LineLandmark)
        nearest = int(np.argmin([abs(line.alpha - row.alpha) for line in found.landmarks()]))
        own = found.landmarks()[nearest]
        # Ends of printed rows are whole image rows, halves where two lines are joined, moved a
        # little by the projection of the last point to the line.
        ends = np.round(2.0 * np.array([_end_rows(line, camera) for line in (row, own)]))
        assert np.abs(np.diff(ends, axis=0)).max() <= 2.0
        assert abs(row.xtop - own.xtop) <= 0.003
        assert abs(row.xbottom - own.xbottom) <= 0.003
        assert abs(row.alpha - own.alpha) <= 0.5 * row.sigma
        assert own.sigma == pytest.approx(row.sigma, rel=0.15)
        # No single printed line has more than 0.003.
        assert (row.sigma > 0.005) == (np.diff(found.lines.bounds)[nearest] > 1)


def _end_rows(line: LineLandmark, camera: Camera) -> np.ndarray:
    """Image rows of a line's ends."""
    return camera.distort([[line.xtop, line.ytop], [line.xbottom, line.ybottom]])[:, 1]


def test_one_call_goes_the_path_of_the_steps() -> None:
    """Starts, tracks and judgement, and doubtful tracks once more, each by itself."""
    camera = leaning_camera(CAMERA, (0.02, -0.01))
    # Edges that are nearly too short and too faint.
    faint = scene(camera, (*EDGES, Edge(0.22, 13.0), Edge(0.06, 13.0)))
    image, horizon = scene(camera), int(np.median(TABLE.anchor_row))
    image[horizon - 16 : horizon + 16] = faint[horizon - 16 : horizon + 16]
    for preset in (DEFAULT, PUBLISHED):
        found = detect_lines(image, TABLE, preset)
        starts = line_starts(image, TABLE, preset)
        tracks = line_tracks(image, starts, TABLE, preset)
        judged = judge_tracks(image, tracks, TABLE, preset)
        if preset.guided:
            assert judged.tilt is not None
            assert judged.doubtful.any()
            tilt = judged.tilt.pitch_rad, judged.tilt.roll_rad
            tracks = tracks_again(image, starts, tracks, judged.doubtful, tilt, TABLE, preset)
            judged = judge_tracks(image, tracks, TABLE, preset, before=judged)
        for name in tracks._fields:
            np.testing.assert_array_equal(getattr(found.tracks, name), getattr(tracks, name))
        for name in found.judged.fits._fields:
            np.testing.assert_array_equal(
                getattr(found.judged.fits, name), getattr(judged.fits, name)
            )
        np.testing.assert_array_equal(found.judged.evidence, judged.evidence)
        assert found.tilt is not None
        assert judged.tilt is not None
        assert found.tilt.pitch_rad == judged.tilt.pitch_rad
        np.testing.assert_array_equal(found.tilt.covariance, judged.tilt.covariance)


@pytest.mark.parametrize("value", [0, 255])
def test_blank_images_give_nothing(value: int) -> None:
    found = detect_lines(np.full((160, 240), value, np.uint8), TABLE)
    assert (len(found), found.tilt, found.landmarks(), found.outcome) == (0, None, (), ())


def test_wrong_images_are_refused() -> None:
    with pytest.raises(FrameError, match="is 241x160 px: the calibration is for 240x160"):
        detect_lines(np.zeros((160, 241), np.uint8), TABLE)


# -- drawings ---------------------------------------------------------------------------------


def test_drawn_lines_lie_on_the_edges() -> None:
    image = np.full((160, 240), 90, np.uint8)
    found = detect_lines(scene(CAMERA), TABLE)
    frame = Frame(Step("x", *[0.0] * 9), found.landmarks())
    picture = draw_rows(image, DiscProjection(CAMERA), ImageRows(lines=frame))
    green = (picture[..., 1] > 150) & (picture[..., 2] < 120)
    rows = np.arange(40, 120)
    for bearing in truth():
        u = np.rint(edge_columns(CAMERA, bearing, rows.astype(np.float64))).astype(int)
        assert np.mean([green[2 * v, 2 * c - 1 : 2 * c + 3].any() for v, c in zip(rows, u)]) > 0.9
    assert picture.shape[1:] == (480, 3)


def test_drawn_tracks_name_their_fates() -> None:
    image = scene(CAMERA)
    found = detect_lines(image, TABLE)
    picture = draw_tracks(image, TABLE, found)
    assert picture.shape[0] > 160
    track = found.lines.members[0]
    pixels = np.rint(track_pixels(found.tracks, TABLE, track)).astype(int)
    assert np.all(picture[pixels[:, 1], pixels[:, 0]] == [60, 220, 60])


# -- photographs and renders with truth ---------------------------------------------------------


def load(path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A scoring script that lies beside the data, with its own neighbours to import."""
    monkeypatch.syspath_prepend(str(path.parent))
    # Its neighbour `camera.py` must not be taken for the project's package, nor stay.
    kept = {name: sys.modules.pop(name, None) for name in ("camera", "geometry")}
    try:
        spec = importlib.util.spec_from_file_location(f"score_{path.parent.name}", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        for name, package in kept.items():
            sys.modules.pop(name, None)
            if package is not None:
                sys.modules[name] = package
    return module


@pytest.mark.long
def test_photographs_of_buildings(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = shared_data / "york"
    annotated = json.loads((folder / "dev" / "truth.json").read_text())
    score = load(folder / "evaluate.py", monkeypatch)
    bearings, covered = {}, []
    for name, real in annotated.items():
        camera = read_camera(folder / "dev" / name / f"{name}.cam")
        image = read_grey(folder / "dev" / name / "images" / f"{name}.jpg")
        found = detect_lines(image, build_vertical_table(camera))
        bearings[name] = found.lines.alpha_rad
        lines = np.array([line["alpha"] for line in real["york"] if line["length"] >= 30])
        for k, _, error_deg in score.match(found.lines.alpha_rad, lines, 0.5):
            covered.append(abs(np.radians(error_deg)) < 2.0 * found.lines.sigma_rad[k])
    limits = type("Limits", (), {"min_gt_len": 30.0, "gt_gap": 10.0})
    result = score.score(bearings, annotated, limits)
    assert result["recall_york@0.25"] > 0.90
    assert result["precision@0.25"] > 0.89
    assert result["err_york_median"] < 0.035
    assert result["err_york_p95"] < 0.20
    assert np.mean(covered) > 0.94


@pytest.mark.long
def test_rendered_office(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = shared_data / "rendered"
    real = json.loads((folder / "r1" / "truth.json").read_text())
    camera = read_camera(folder / "r1" / "r1.cam")
    table = build_vertical_table(camera)
    rows, errors, squared = {}, [], []
    for frame in real["frames"]:
        image = read_grey(folder / "r1" / "images" / f"{frame['prefix']}.jpg")
        found = detect_lines(image, table)
        bearings = zip(found.lines.alpha_rad, found.lines.beta_rad, found.lines.sigma_rad)
        rows[frame["prefix"]] = {"L": [[0, 0, 0, 0, a, b, 0, s] for a, b, s in bearings]}
        if found.tilt is not None and found.tilt.lines >= 5:
            error = np.array([found.tilt.pitch_rad, found.tilt.roll_rad]) - frame["tilt"]
            errors.append(np.degrees(error))
            squared.append(error @ np.linalg.solve(found.tilt.covariance, error) / 2.0)
    score = load(folder / "evaluate.py", monkeypatch)
    result = score.score_lines(real, rows)
    assert result["recall"] > 0.95
    assert result["fp_rate"] <= 0.01
    assert result["bearing_err_median_deg"] < 0.05
    assert result["bearing_err_95_deg"] < 0.25
    assert 0.7 < result["norm_err2_mean"] < 1.3
    assert len(errors) > 50
    assert np.all(np.sqrt(np.mean(np.square(errors), axis=0)) < 0.15)
    # Rendered walls are truer than those that the stated errors are made for.
    assert 0.05 < np.mean(squared) < 1.4
