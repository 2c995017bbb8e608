"""Conversion: formats read back, half a pixel, models against their own programs, limits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera import Camera, read_camera, write_camera
from camera.cli import main
from camera.errors import ConversionError
from camera.formats.colmap import (
    MODELS as COLMAP_MODELS,
)
from camera.formats.colmap import (
    camera_from_pycolmap,
    format_colmap,
    parse_colmap,
    pycolmap_from_camera,
)
from camera.formats.conversion import convert_to_camera, convert_to_foreign
from camera.formats.models import ForeignCamera
from camera.formats.yaml_files import (
    camera_of_info,
    format_kalibr,
    format_opencv,
    format_ros,
    parse_kalibr,
    parse_opencv,
    parse_ros,
    parse_yaml,
)
from redetect.array_types import FloatArray
from tools.evaluation.boards import projection_difference

RADTAN = ForeignCamera(
    "radtan", 640, 480, 500.0, 505.0, 318.5, 241.0, (-0.3, 0.1, 1e-3, -5e-4, 0.0)
)
RATIONAL = ForeignCamera(
    "rational", 640, 480, 500.0, 505.0, 318.5, 241.0,
    (0.5, 0.1, 1e-3, -5e-4, 0.01, 0.8, 0.2, 0.03),
)  # fmt: skip
FISHEYE = ForeignCamera(
    "fisheye", 640, 480, 300.0, 301.0, 318.5, 241.0, (-0.01, 0.02, -0.005, 1e-3)
)
RAYS = np.random.default_rng(1).uniform(-0.6, 0.6, size=(200, 2))


def as_opencv_projects(camera: ForeignCamera, rays: FloatArray) -> FloatArray:
    points = np.column_stack([rays, np.ones(len(rays))])
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    zero = np.zeros(3)
    d = np.array(camera.distortion)
    if camera.model == "fisheye":
        found = cv2.fisheye.projectPoints(points[:, None], zero, zero, K, d)[0]
    else:
        found = cv2.projectPoints(points, zero, zero, K, d)[0]
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


@pytest.mark.lowest
@pytest.mark.parametrize("camera", [RADTAN, RATIONAL, FISHEYE], ids=lambda c: c.model)
def test_models_are_opencvs_and_invert(camera: ForeignCamera) -> None:
    pixels = camera.distort(RAYS)
    np.testing.assert_allclose(pixels, as_opencv_projects(camera, RAYS), atol=1e-9)
    np.testing.assert_allclose(camera.undistort(pixels), RAYS, atol=1e-9)


@pytest.mark.lowest
@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=lambda c: c.model)
def test_colmap_counts_from_the_corner(camera: ForeignCamera) -> None:
    theirs = pycolmap_from_camera(camera)
    points = np.column_stack([RAYS, np.ones(len(RAYS))])
    np.testing.assert_allclose(
        np.asarray(theirs.img_from_cam(points)) - 0.5, camera.distort(RAYS), atol=1e-9
    )
    assert camera_from_pycolmap(theirs) == camera


@pytest.mark.parametrize("name", list(COLMAP_MODELS))
def test_colmaps_models_have_as_many_parameters(name: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    _, focals, coefficients = COLMAP_MODELS[name]
    parameters = pycolmap.Camera(model=name).params_info.split(",")
    assert len(parameters) == focals + 2 + coefficients


@pytest.mark.lowest
def test_formats_read_back_what_they_wrote() -> None:
    for camera in (RADTAN, RATIONAL, FISHEYE):
        assert parse_opencv(format_opencv(camera)) == camera
        assert parse_ros(format_ros(camera)) == camera
    for camera in (RADTAN, FISHEYE):
        assert parse_kalibr(format_kalibr(camera)) == camera
    for camera in (RADTAN, RATIONAL, FISHEYE):
        assert parse_colmap(format_colmap(camera)) == camera


@pytest.mark.lowest
def test_opencv_reads_what_is_written_and_the_other_way(tmp_path: Path) -> None:
    path = tmp_path / "ours.yaml"
    path.write_text(format_opencv(RADTAN))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K = storage.getNode("camera_matrix").mat()
    d = storage.getNode("distortion_coefficients").mat()
    storage.release()
    assert K[0, 0] == RADTAN.fx
    np.testing.assert_array_equal(d.ravel(), RADTAN.distortion)
    theirs = tmp_path / "theirs.yaml"
    storage = cv2.FileStorage(str(theirs), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", d)
    storage.release()
    assert parse_opencv(theirs.read_text()) == RADTAN


@pytest.mark.lowest
def test_an_echoed_ros_message_is_read() -> None:
    text = (
        "header:\n  frame_id: camera\nheight: 480\nwidth: 640\ndistortion_model: plumb_bob\n"
        "d: [-0.3, 0.1, 1e-3, -5e-4, 0]\nk: [500, 0, 318.5, 0, 505, 241, 0, 0, 1]\n"
        "roi: {width: 0, height: 0}\n---\nnext: 1\n"
    )
    assert parse_ros(text) == RADTAN


def test_an_uncalibrated_ros_camera_is_refused() -> None:
    with pytest.raises(ConversionError, match="not calibrated"):
        camera_of_info({"width": 640, "height": 480, "d": [], "k": [0.0] * 9}, "info")


@pytest.mark.long
def test_the_published_camera_there_and_back(published_camera: Camera) -> None:
    there = convert_to_foreign(published_camera, "rational", "double")
    assert there.deviation_px < 0.05
    assert there.camera.height == 576
    # Measured apart from the conversion's own measure: OpenCV's projection of the camera's rays.
    rng = np.random.default_rng(4)
    pixels = rng.uniform([0.0, 0.0], [767.0, 287.0], size=(3000, 2))
    assert isinstance(there.camera, ForeignCamera)
    found = as_opencv_projects(there.camera, published_camera.undistort(pixels))
    assert (
        np.linalg.norm(found - pixels * [1.0, 2.0], axis=1).max() < 1.05 * there.deviation_px + 1e-3
    )
    back = convert_to_camera(there.camera, "halve")
    assert isinstance(back.camera, Camera)
    assert projection_difference(published_camera, back.camera, rotate=False).max() < 0.01


def test_half_height_keeps_what_even_lines_see() -> None:
    full = convert_to_camera(
        ForeignCamera("radtan", 768, 576, 460.0, 460.0, 383.0, 287.0, (0.0,) * 5)
    )
    half = convert_to_camera(full.camera, "halve")
    assert isinstance(half.camera, Camera)
    assert isinstance(full.camera, Camera)
    assert (half.camera.height, half.camera.scale_y, half.camera.offset_y) == (288, 230.0, 143.5)
    lines = np.array([[100.0, 20.0], [700.0, 280.0]])
    np.testing.assert_allclose(
        half.camera.undistort(lines), full.camera.undistort(lines * [1.0, 2.0]), atol=1e-12
    )


@pytest.mark.parametrize(("p1", "p2"), [(-5e-3, 3e-3), (2e-3, 5e-3)])
@pytest.mark.parametrize("k", [(-0.2, 0.05, -0.005)])
def test_tangential_distortion_comes_over_and_goes_back(
    p1: float, p2: float, k: tuple[float, float, float]
) -> None:
    source = ForeignCamera(
        "radtan", 640, 480, 500.0, 505.0, 318.5, 241.0, (k[0], k[1], p1, p2, k[2])
    )
    there = convert_to_camera(source)
    camera = there.camera
    assert isinstance(camera, Camera)
    assert there.deviation_px < 0.02
    assert camera.tangential == pytest.approx((p1, p2), abs=1e-4)
    # Measured apart from the conversion: OpenCV's projection of what the camera's pixels see.
    pixels = np.random.default_rng(2).uniform([0.0, 0.0], [639.0, 479.0], size=(2000, 2))
    away = np.linalg.norm(as_opencv_projects(source, camera.undistort(pixels)) - pixels, axis=1)
    assert away.max() < 1.05 * there.deviation_px + 1e-3
    back = convert_to_foreign(camera, "radtan")
    assert back.deviation_px < 0.02
    assert isinstance(back.camera, ForeignCamera)
    np.testing.assert_allclose(back.camera.distort(RAYS), source.distort(RAYS), atol=0.05)


def test_without_radial_terms_the_tangential_ones_go_and_come_exactly() -> None:
    source = ForeignCamera(
        "rational", 640, 480, 500.0, 505.0, 318.5, 241.0, (0.0, 0.0, 2e-3, -3e-3, *(0.0,) * 4)
    )
    there = convert_to_camera(source)
    assert isinstance(there.camera, Camera)
    assert there.camera.tangential == (2e-3, -3e-3)
    assert there.deviation_px < 1e-9
    assert convert_to_foreign(there.camera, "rational").camera == source
    half = convert_to_camera(there.camera, "halve").camera
    assert isinstance(half, Camera)
    assert half.tangential == (2e-3, -3e-3)
    lines = np.array([[100.0, 20.0], [600.0, 230.0]])
    np.testing.assert_allclose(
        half.undistort(lines), there.camera.undistort(lines * [1.0, 2.0]), atol=1e-12
    )
    # What has no such terms shows it.
    assert convert_to_foreign(there.camera, "fisheye").deviation_px > 0.1


@pytest.mark.parametrize("focal_px", [420.0, 370.0, 330.0])
def test_a_wide_fisheye_lens_is_followed(focal_px: float) -> None:
    """Corners are 55 to 69 degrees off the axis: least squares from a pinhole ends pixels away."""
    distortion = (-0.02, 0.004, -0.001, 0.0)
    lens = ForeignCamera("fisheye", 640, 480, focal_px, focal_px, 320.0, 240.0, distortion)
    assert convert_to_camera(lens).deviation_px < 0.02


def test_a_lens_that_changes_from_barrel_to_pincushion_is_followed() -> None:
    """From a lens without distortion least squares ends a pixel away."""
    wavy = ForeignCamera(
        "radtan", 640, 480, 500.0, 500.0, 319.5, 239.5, (0.1, -0.2, 5e-3, 5e-3, 0.05)
    )
    found = convert_to_camera(wavy)
    assert found.deviation_px < 0.05
    assert isinstance(found.camera, Camera)
    pixels = np.random.default_rng(2).uniform([0.0, 0.0], [639.0, 479.0], size=(500, 2))
    seen = as_opencv_projects(wavy, found.camera.undistort(pixels))
    np.testing.assert_allclose(seen, pixels, atol=0.05)


def test_a_thin_prism_is_refused() -> None:
    text = (
        format_opencv(RATIONAL)
        .replace("rows: 8", "rows: 12")
        .replace("0.03]", "0.03, 0, 0, 0.04, 0]")
    )
    assert "0.04, 0]" in text
    with pytest.raises(ConversionError, match=r"a thin prism or a tilted sensor"):
        parse_opencv(text)
    assert parse_opencv(text.replace("0.04", "0")) == RATIONAL


def test_a_fold_inside_the_image_is_kept(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Calibrations often fold in the corners, where there was no board."""
    folded = ForeignCamera(
        "radtan", 640, 480, 500.0, 500.0, 320.0, 240.0, (0.17, -0.7, -0.003, -0.005, 0.0)
    )
    found = convert_to_camera(folded)
    assert isinstance(found.camera, Camera)
    assert found.deviation_px < 1e-6
    corner, centre = np.array([[1.0, 1.0]]), np.array([[320.0, 240.0]])
    for camera in (folded, found.camera):
        assert np.isnan(camera.undistort(corner)).all()
        assert np.isfinite(camera.undistort(centre)).all()
    source = tmp_path / "folded.yaml"
    source.write_text(format_ros(folded))
    assert main(["convert", str(source), str(tmp_path / "folded.cam")]) == 0
    unseen = 100.0 * (1.0 - found.camera.seen_share)
    assert 1.0 < unseen < 20.0
    assert f"{unseen:.1f} % of the image, past the distortion's fold" in capsys.readouterr().out
    assert read_camera(tmp_path / "folded.cam").seen_share == found.camera.seen_share


@given(st.floats(150.0, 500.0), st.floats(-0.6, 0.1), st.floats(-0.2, 0.3), st.floats(-0.1, 0.1))
def test_pixels_before_the_fold_are_seen_and_none_beyond(
    focal_px: float, k1: float, k2: float, k3: float
) -> None:
    lens = ForeignCamera(
        "radtan", 640, 480, focal_px, focal_px, 320.0, 240.0, (k1, k2, 0.0, 0.0, k3)
    )
    radius = np.linspace(0.0, 4.0, 40_001)
    seen_at = radius * (1.0 + k1 * radius**2 + k2 * radius**4 + k3 * radius**6)
    rising = np.append(np.diff(seen_at) > 0.0, [False])
    fold = int(np.argmin(rising))
    u = np.linspace(320.0, 720.0, 81)
    found = lens.undistort(np.stack([u, np.full(81, 240.0)], axis=1))[:, 0]
    off = (u - 320.0) / focal_px
    sure = np.abs(off - seen_at[fold]) > 1e-3
    expected = np.interp(off, seen_at[: fold + 1], radius[: fold + 1], right=np.nan)
    np.testing.assert_allclose(found[sure], expected[sure], atol=1e-4)


def test_a_lens_that_sees_less_than_half_of_the_image_is_refused() -> None:
    folded = ForeignCamera(
        "radtan", 640, 480, 150.0, 150.0, 320.0, 240.0, (-0.6, 0.0, 0.0, 0.0, 0.0)
    )
    with pytest.raises(ConversionError, match="% of the image is seen: expected at least 50 %"):
        convert_to_camera(folded)


def test_aliases_are_refused() -> None:
    bomb = "a: &a [x, x]\nb: &b [*a, *a]\nimage_width: 3\n"
    with pytest.raises(ConversionError, match=r"bomb:2: an alias"):
        parse_yaml(bomb, "bomb")


def test_python_objects_are_not_made() -> None:
    with pytest.raises(ConversionError, match="expected YAML"):
        parse_yaml("a: !!python/object/apply:os.system ['true']\n", "evil")


@given(st.text(max_size=300))
def test_no_text_does_worse_than_an_error(text: str) -> None:
    for parse in (parse_opencv, parse_ros, parse_kalibr, parse_colmap):
        with pytest.raises(ConversionError):
            parse(text)


def test_a_lens_too_wide_for_cam_files_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wide = ForeignCamera("fisheye", 752, 480, 308.0, 308.0, 376.0, 240.0, (0.0,) * 4)
    source = tmp_path / "wide.kalibr.yaml"
    source.write_text(format_kalibr(wide))
    assert main(["convert", str(source), str(tmp_path / "wide.cam")]) == 1
    assert "the lens sees 83 degrees off its axis, 80 of which" in capsys.readouterr().err
    assert not (tmp_path / "wide.cam").exists()


def test_the_command_converts_and_refuses(
    tmp_path: Path, published_camera: Camera, capsys: pytest.CaptureFixture[str]
) -> None:
    cam, plumb_bob = tmp_path / "e.cam", tmp_path / "p.cam"
    write_camera(published_camera, cam)
    write_camera(
        replace(published_camera, coef=(0.0,) * 5, polynomial=(-0.1, 0.02, 0.0)), plumb_bob
    )
    yaml = tmp_path / "p.opencv.yaml"
    assert main(["convert", str(plumb_bob), str(yaml)]) == 0
    assert "largest deviation over the image" in capsys.readouterr().out
    back = tmp_path / "back.cam"
    assert main(["convert", str(yaml), str(back), "--pose-from", str(plumb_bob)]) == 0
    assert read_camera(back) == read_camera(plumb_bob)
    kalibr = tmp_path / "e.kalibr.yaml"
    to_kalibr = ["convert", str(cam), str(kalibr), "--model", "fisheye"]
    assert main(to_kalibr) == 1
    assert "--limit-px" in capsys.readouterr().err
    assert not kalibr.exists()
    for limit in ("nan", "-1"):
        with pytest.raises(SystemExit):
            main([*to_kalibr, "--limit-px", limit])
        assert capsys.readouterr().err == f"error: --limit-px is {limit}: expected 0 or more\n"
    assert main([*to_kalibr, "--limit-px", "0.2"]) == 0
    assert parse_kalibr(kalibr.read_text()).model == "fisheye"
    assert main(["convert", str(cam), str(tmp_path / "e.yaml")]) == 1
    assert "does not say which format" in capsys.readouterr().err
    assert main(["convert", str(cam), str(yaml)]) == 1
    assert "--force" in capsys.readouterr().err
