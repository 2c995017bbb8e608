"""Files of other programs as they come: names, COLMAP's binary, what a newcomer meets."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera import Camera
from camera.cli import main
from camera.errors import ConversionError
from camera.formats.colmap import text_of_binary
from camera.formats.command import convert, format_of, format_of_text, parse, read_text
from camera.formats.conversion import convert_to_camera
from camera.formats.models import ForeignCamera, Model
from camera.formats.yaml_files import format_kalibr, format_ros, parse_kalibr, parse_ros, parse_yaml
from camera.options import Convert, Format

RADTAN = ForeignCamera(
    "radtan", 640, 480, 500.0, 505.0, 318.5, 241.0, (-0.3, 0.1, 1e-3, -5e-4, 0.0)
)


def test_names_go_only_where_a_format_has_such_names() -> None:
    for given_name, number, key, word in (
        ("", "1", "cam0", "camera"),
        ("7", "7", "cam0", "camera"),
        ("cam3", "1", "cam3", "cam3"),
        ("left: [eye", "1", "cam0", "camera"),
    ):
        assert format_of(RADTAN, "colmap", given_name).splitlines()[-1].split()[0] == number
        assert list(parse_yaml(format_of(RADTAN, "kalibr", given_name), "k")) == [key]
        assert parse_yaml(format_of(RADTAN, "ros", given_name), "r")["camera_name"] == word
        formats: tuple[Format, ...] = ("colmap", "kalibr", "ros")
        for to_format in formats:
            assert parse(format_of(RADTAN, to_format, given_name), to_format, "x") == RADTAN


def test_colmaps_binary_is_its_text(tmp_path: Path) -> None:
    import pycolmap

    theirs = pycolmap.Reconstruction()
    models = {
        "SIMPLE_RADIAL": (500.1, 320.0, 240.0, -0.02),
        "FOV": (400.0, 400.0, 320.0, 240.0, 0.9),
        "PINHOLE": (500.0, 501.0, 320.0, 240.0),
        "THIN_PRISM_FISHEYE": (400.0, 400.0, 320.0, 240.0, *(0.01,) * 8),
        "FULL_OPENCV": (500.0, 501.0, 320.0, 240.0, 0.1, -0.2, 1e-3, -2e-3, 0.03, 0.1, -0.1, 1e-9),
        "OPENCV_FISHEYE": (400.0, 401.0, 320.0, 240.0, 0.01, -0.002, 1e-4, 0.0),
    }
    for number, (model, values) in enumerate(models.items(), start=1):
        made = pycolmap.Camera(model=model, width=640, height=480, params=values, camera_id=number)
        theirs.add_camera(made)
    theirs.write_binary(str(tmp_path))
    theirs.write_text(str(tmp_path))
    binary, text = tmp_path / "cameras.bin", tmp_path / "cameras.txt"
    for number, model in enumerate(models, start=1):
        told: list[ForeignCamera | str] = []
        for path in (binary, text):
            lines = read_text(path)
            assert format_of_text(path, lines) == "colmap"
            try:
                found = parse(lines, "colmap", "", str(number))
                assert isinstance(found, ForeignCamera)
                told.append(found)
            except ConversionError as error:
                told.append(str(error).partition(" ")[2])
        assert told[0] == told[1]
        assert isinstance(told[0], str) == (model in ("FOV", "THIN_PRISM_FISHEYE"))
    content = binary.read_bytes()
    with pytest.raises(ConversionError, match="ends early"):
        text_of_binary(content[:-1])
    with pytest.raises(ConversionError, match="1 bytes behind its 6 cameras"):
        text_of_binary(content + b"\0")
    with pytest.raises(ConversionError, match=r"camera 1 has COLMAP's model 99.*model_converter"):
        text_of_binary(content[:12] + b"\x63" + content[13:])


@given(st.binary(max_size=200))
def test_no_binary_does_worse_than_an_error(content: bytes) -> None:
    with suppress(ConversionError):
        text_of_binary(content)


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
        ("rational", (0.2, -0.1, 1e-3, -5e-4, 0.01, 0.3, 0.02, 0.0, 2e-3, 1e-4, -1e-3, 0.0),
         ("opencv", "ros")),
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
    with pytest.raises(ConversionError, match="cam0: distortion_coeffs without a distortion_model"):
        parse_kalibr(text, "chain")
    none = text.replace("-0.3, 0.1, 0.001, -0.0005", "0.0, 0.0, 0.0, 0.0")
    assert not any(parse_kalibr(none, "chain").distortion)


def test_two_cameras_of_one_number_are_refused() -> None:
    text = "1 PINHOLE 640 480 500 500 320 240\n1 PINHOLE 64 48 50 50 32 24\n"
    with pytest.raises(ConversionError, match="list:2: camera 1 a second time, after line 1"):
        parse(text, "colmap", "list", "1")
