"""Files of other programs as they come: names, COLMAP's binary, what a newcomer meets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera import Camera, read_camera, write_camera
from camera.cli import main
from camera.errors import ConversionError
from camera.formats.conversion import convert_to_camera
from camera.formats.files import FORMATS, convert, format_of_text, parse
from camera.formats.models import ForeignCamera, Model
from camera.formats.yaml_files import format_kalibr, format_ros, parse_kalibr, parse_ros
from camera.options import Convert, Format
from camera.uncertainty import with_covariance

RADTAN = ForeignCamera(
    "radtan", 640, 480, 500.0, 505.0, 318.5, 241.0, (-0.3, 0.1, 1e-3, -5e-4, 0.0)
)


def test_a_region_that_is_the_whole_image_is_none() -> None:
    text = format_ros(RADTAN)
    whole = f"roi: {{x_offset: 0, y_offset: 0, width: {RADTAN.width}, height: {RADTAN.height}}}\n"
    assert parse_ros(text + whole) == RADTAN
    assert parse_ros(text + "roi: {x_offset: 0, width: 0, do_rectify: false}\n") == RADTAN
    for part in ("{x_offset: 8, width: 0}", f"{{width: {RADTAN.width - 8}, height: 1}}"):
        with pytest.raises(ConversionError, match="roi is"):
            parse_ros(text + f"roi: {part}\n")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.xml", "<?xml version='1.0'?>", "a.xml:1: no element found"),
        ("a.xml", "<!DOCTYPE a [<!ENTITY b '3'>]><a><M1>&b;</M1></a>", "XML with declarations"),
        ("a.xml", "<a><M1>3</M1><M1>4</M1></a>", "'M1' twice: expected it once"),
        ("a.xml", "<opencv_storage><M1>3</M1></opencv_storage>", "lacks image_width"),
        ("a.yml", "%YAML:1.0\n---\nM1: 3\n", "lacks image_width: add the images' size"),
        ("a.yml", "%YAML:1.0\n---\nimage_Width: 3\n", "lacks image_height: add the images' size"),
        ("a.yml", "intrinsics: [1, 1, 1, 1]\n", "cam0: lacks resolution"),
        ("a.yml", "cam0: {resolution: [1, 1]}\n", "cam0 with intrinsics"),
        ("a.yml", "image_width: !!int ''\n", "invalid YAML"),
        ("a.yml", "image_width: !!float ''\n", "invalid YAML"),
        ("a.yml", "image_width: !!timestamp foo\n", "invalid YAML"),
        ("a.yml", "image_width: !!bool foo\n", "invalid YAML"),
    ],
)
def test_what_is_missing_is_told_with_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, text: str, message: str
) -> None:
    (tmp_path / name).write_text(text)
    assert main(["convert", str(tmp_path / name), str(tmp_path / "b.cam")]) == 1
    told = capsys.readouterr().err
    assert message in told
    assert name in told


def test_other_lines_of_the_same_camera_keep_all_else(published_camera: Camera) -> None:
    camera = replace(published_camera, mount_index=3, unknown=(("serial", "4711"),))
    there = convert_to_camera(camera, "double").camera
    assert isinstance(there, Camera)
    assert (there.height, there.unknown) == (2 * camera.height, camera.unknown)
    assert convert_to_camera(there, "halve").camera == camera


def test_what_cannot_be_converted_names_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wide = ForeignCamera("fisheye", 512, 512, 100.0, 100.0, 255.5, 255.5, (0.0,) * 4)
    source = tmp_path / "wide.yaml"
    source.write_text(format_kalibr(wide))
    assert main(["convert", str(source), str(tmp_path / "b.cam")]) == 1
    assert f"error: {source}: only 29 % of the image is seen" in capsys.readouterr().err


def test_opencv_reads_and_writes_the_same_in_xml(tmp_path: Path) -> None:
    source = tmp_path / "out_camera_data.xml"
    storage = cv2.FileStorage(str(source), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Tue Apr 19 12:00:00 2016")
    storage.writeComment("flags: +fix_aspectRatio")
    storage.write("image_width", RADTAN.width)
    storage.write("image_height", RADTAN.height)
    storage.write("camera_matrix", np.array(RADTAN.matrix).reshape(3, 3))
    storage.write("distortion_coefficients", np.array(RADTAN.distortion))
    storage.release()
    text = source.read_text()
    assert format_of_text(source, text) == "opencv"
    assert parse(text, "opencv", str(source)) == RADTAN


def test_a_sensor_of_euroc_is_a_camera_of_a_chain() -> None:
    """Its published cam0; a camchain holds the same."""
    text = """
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
    path = Path("sensor.yaml")
    assert format_of_text(path, text) == format_of_text(path, f"%YAML:1.0{text}") == "kalibr"
    camera = parse(text, "kalibr", "sensor.yaml")
    assert isinstance(camera, ForeignCamera)
    assert camera.pinhole == (458.654, 457.296, 367.215, 248.375)
    assert camera.distortion == (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0)
    assert parse(format_kalibr(camera), "kalibr", "camchain.yaml") == camera


@pytest.mark.parametrize(
    ("model", "distortion", "formats"),
    [
        ("radtan", (-0.3, 0.1, 1e-3, -5e-4, -0.02), ("opencv", "ros", "colmap")),
        ("rational", (0.2, -0.1, 1e-3, -5e-4, 0.01, 0.3, 0.02, 0.0), ("opencv", "ros", "colmap")),
    ],
)  # fmt: skip
def test_what_a_format_holds_is_taken_over(
    model: Model, distortion: tuple[float, ...], formats: tuple[Format, ...]
) -> None:
    source = ForeignCamera(model, 640, 480, 500.0, 505.0, 318.5, 241.0, distortion)
    rays = np.random.default_rng(3).uniform(-0.5, 0.5, size=(50, 2))
    for to_format in formats:
        # However much the loss of a term would be allowed to show.
        options = Convert(Path("source"), Path("target"), limit_px=100.0)
        found = convert(source, to_format, options).camera
        back = parse(FORMATS[to_format].format(found), to_format, "back")
        np.testing.assert_allclose(back.distort(rays), source.distort(rays), rtol=0, atol=1e-9)


def test_a_polynomial_of_three_terms_stays_whole_in_colmaps_format() -> None:
    source = replace(RADTAN, distortion=(-0.3, 0.1, 1e-3, -5e-4, -0.02))
    camera = convert_to_camera(source).camera
    options = Convert(Path("source"), Path("cameras.txt"), limit_px=100.0)
    text = FORMATS["colmap"].format(convert(camera, "colmap", options).camera)
    back = parse(text, "colmap", "back")
    assert isinstance(back, ForeignCamera)
    assert back.distortion[:5] == source.distortion
    assert not any(back.distortion[5:])


def test_kalibrs_coefficients_of_no_model_are_refused() -> None:
    text = format_kalibr(RADTAN).replace("  distortion_model: radtan\n", "")
    with pytest.raises(ConversionError, match=r"distortion_model 'none': .* or none without"):
        parse_kalibr(text, "chain")
    none = text.replace("-0.3, 0.1, 0.001, -0.0005", "0.0, 0.0, 0.0, 0.0")
    assert not any(parse_kalibr(none, "chain").distortion)


def test_two_cameras_of_one_number_are_refused() -> None:
    text = "1 PINHOLE 640 480 500 500 320 240\n1 PINHOLE 64 48 50 50 32 24\n"
    with pytest.raises(ConversionError, match="list:2: camera 1 a second time, after line 1"):
        parse(text, "colmap", "list", "1")


@pytest.mark.parametrize(
    ("source", "target", "flags", "message"),
    [
        ("a.cam", "b.cam", ["--model", "fisheye"], "expected no --model"),
        ("a.cam", "b.ros.yaml", ["--pose-from", "absent.cam"], "expected no --pose-from"),
        ("a.cam", "b.ros.yaml", ["--camera-name", "cam0"], "expected no --camera-name"),
        ("a.ros.yaml", "b.cam", ["--camera-name", "cam0"], "expected no --camera-name"),
    ],
)
def test_flags_without_effect_are_refused(
    tmp_path: Path, published_camera: Camera, capsys: pytest.CaptureFixture[str],
    source: str, target: str, flags: list[str], message: str,
) -> None:  # fmt: skip
    write_camera(published_camera, tmp_path / "a.cam")
    (tmp_path / "a.ros.yaml").write_text(format_ros(RADTAN))
    assert main(["convert", str(tmp_path / source), str(tmp_path / target), *flags]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / target).exists()


def test_a_covariance_is_kept_where_it_is_still_true(
    tmp_path: Path, published_camera: Camera, capsys: pytest.CaptureFixture[str]
) -> None:
    known = with_covariance(published_camera, 1e-6 * np.eye(20))
    write_camera(known, tmp_path / "a.cam")
    convert_a = ["convert", str(tmp_path / "a.cam"), str(tmp_path / "b.cam"), "--force"]
    assert main(convert_a) == 0
    assert read_camera(tmp_path / "b.cam") == known
    assert "dropped" not in capsys.readouterr().out
    for flags in (["--rows", "double"], ["--pose-from", str(tmp_path / "a.cam")]):
        assert main([*convert_a, *flags]) == 0
        assert read_camera(tmp_path / "b.cam").covariance is None
        assert "the covariance is dropped" in capsys.readouterr().out
