"""Files of other programs as they come: names, COLMAP's binary, what a newcomer meets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from camera import Camera
from camera.cli import main
from camera.errors import ConversionError
from camera.formats.conversion import convert_to_camera
from camera.formats.files import convert, format_of, parse
from camera.formats.models import ForeignCamera, Model
from camera.formats.yaml_files import format_kalibr, format_ros, parse_kalibr, parse_ros
from camera.options import Convert, Format

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
        ("a.xml", "<?xml version='1.0'?>", "is XML: expected YAML"),
        ("a.yml", "%YAML:1.0\n---\nM1: 3\n", "lacks image_width: add the images' size"),
        ("a.yml", "%YAML:1.0\n---\nimage_Width: 3\n", "lacks image_height: add the images' size"),
        ("a.yml", "intrinsics: [1, 1, 1, 1]\n", "cam0 with intrinsics"),
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
    wide = ForeignCamera("fisheye", 512, 512, 190.0, 190.0, 255.5, 255.5, (0.0,) * 4)
    source = tmp_path / "wide.yaml"
    source.write_text(format_kalibr(wide))
    assert main(["convert", str(source), str(tmp_path / "b.cam")]) == 1
    assert f"error: {source}: pixel (0, 0) sees nothing" in capsys.readouterr().err


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
        back = parse(format_of(found, to_format), to_format, "back")
        np.testing.assert_allclose(back.distort(rays), source.distort(rays), rtol=0, atol=1e-9)


def test_a_polynomial_of_three_terms_stays_whole_in_colmaps_format() -> None:
    source = replace(RADTAN, distortion=(-0.3, 0.1, 1e-3, -5e-4, -0.02))
    camera = convert_to_camera(source).camera
    options = Convert(Path("source"), Path("cameras.txt"), limit_px=100.0)
    back = parse(format_of(convert(camera, "colmap", options).camera, "colmap"), "colmap", "back")
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
