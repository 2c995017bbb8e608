"""A camera is a value; what cannot be a camera is refused by name."""

from __future__ import annotations

import dataclasses
import math
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from camera import Camera, CameraError, parse_camera
from tests.camera.strategies import cameras

GEOMETRIC: list[tuple[str, Any]] = [
    ("width", 767),
    ("height", 287),
    ("scale_x", 464.763),
    ("scale_y", 232.382),
    ("offset_x", 384.001),
    ("offset_y", 144.001),
    *(
        ("coef", tuple(c + 1e-6 * (k == at) for k, c in enumerate(
            (-0.0620672, -0.324903, 0.314764, 1.52524, -0.480806)
        )))
        for at in range(5)
    ),
]  # fmt: skip


def replace(camera: Camera, **changes: Any) -> Camera:
    """The camera with other fields, of whatever type."""
    return dataclasses.replace(camera, **changes)


def test_cameras_made_of_the_same_are_the_same(
    published_camera: Camera, published_cam_text: str
) -> None:
    other = parse_camera(published_cam_text)
    assert other is not published_camera
    assert other == published_camera
    assert hash(other) == hash(published_camera)
    assert other.content_hash == published_camera.content_hash
    assert len({other, published_camera}) == 1


@given(cameras())
def test_a_camera_survives_pickling_and_its_own_repr(camera: Camera) -> None:
    assert pickle.loads(pickle.dumps(camera)) == camera
    assert eval(repr(camera)) == camera


def test_the_type_of_the_numbers_makes_no_difference(published_camera: Camera) -> None:
    other = replace(
        published_camera,
        width=np.int32(768),
        coef=np.array(published_camera.coef),
        robot_from_camera=np.array(published_camera.robot_from_camera),
        unknown=[],
    )
    assert other == published_camera
    assert hash(other) == hash(published_camera)
    assert repr(other) == repr(published_camera)
    assert other.content_hash == published_camera.content_hash


def test_zero_and_minus_zero_are_the_same_camera(published_camera: Camera) -> None:
    plus = dataclasses.replace(published_camera, coef=(0.0,) * 5)
    minus = dataclasses.replace(published_camera, coef=(-0.0,) * 5)
    assert plus == minus
    assert plus.content_hash == minus.content_hash


@pytest.mark.parametrize(("field", "value"), GEOMETRIC)
def test_every_geometric_field_decides_identity_and_content_hash(
    published_camera: Camera, field: str, value: object
) -> None:
    other = replace(published_camera, **{field: value})
    assert other != published_camera
    assert other.content_hash != published_camera.content_hash


@pytest.mark.parametrize("row", range(3))
@pytest.mark.parametrize("column", range(4))
def test_every_number_of_the_pose_decides_the_content_hash(
    published_camera: Camera, row: int, column: int
) -> None:
    pose = np.array(published_camera.robot_from_camera)
    pose[row, column] += 1e-6
    other = replace(published_camera, robot_from_camera=pose)
    assert other != published_camera
    assert other.content_hash != published_camera.content_hash


@pytest.mark.parametrize(
    ("field", "value"),
    [("sensor_to_tcp", None), ("mount_index", 3), ("unknown", (("gain", "2"),))],
)
def test_what_decides_no_pixel_does_not_change_the_content_hash(
    published_camera: Camera, field: str, value: object
) -> None:
    other = replace(published_camera, **{field: value})
    assert other != published_camera
    assert other.content_hash == published_camera.content_hash


def test_nothing_of_a_camera_can_be_changed(published_camera: Camera) -> None:
    for field in dataclasses.fields(published_camera):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(published_camera, field.name, getattr(published_camera, field.name))
    for array in (
        published_camera.rotation,
        published_camera.camera_from_robot,
        published_camera.centre,
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_a_camera_does_not_follow_the_arrays_it_was_made_of(published_camera: Camera) -> None:
    pose = np.array(published_camera.robot_from_camera)
    other = replace(published_camera, robot_from_camera=pose)
    pose[:] = 0.0
    assert other == published_camera


def test_a_camera_prints_as_one_line_that_says_what_it_is(published_camera: Camera) -> None:
    assert str(published_camera) == (
        "768x288 px, scale 464.762 x 232.381 px, centre 384 144, 1.504 m above the floor, "
        "looking 28.4 deg down"
    )


@given(cameras())
def test_the_inverse_rotation_is_one(camera: Camera) -> None:
    assert np.abs(camera.camera_from_robot @ camera.rotation - np.eye(3)).max() < 1e-14
    assert np.abs(camera.camera_from_robot - camera.rotation.T).max() < 1e-5


IDENTITY = np.eye(4)[:3]


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"width": 0}, "width is 0: expected 1 to 65536"),
        ({"height": -3}, "height is -3: expected 1 to 65536"),
        ({"width": 65537}, "width is 65537"),
        ({"width": 768.5}, "width is 768.5: expected a whole number"),
        ({"height": float("nan")}, "height is nan: expected a whole number"),
        ({"scale_x": -464.762}, "scaleX is -464.762: expected a positive"),
        ({"scale_y": 0.0}, "scaleY is 0.0: expected a positive"),
        ({"scale_x": float("nan")}, "scaleX is nan: expected a finite"),
        ({"scale_y": float("inf")}, "scaleY is inf: expected a finite"),
        ({"offset_x": float("nan")}, "offsetX is nan"),
        ({"offset_y": float("-inf")}, "offsetY is -inf"),
        ({"coef": (0.0, 0.0, float("nan"), 0.0, 0.0)}, "coef b1 is nan"),
        ({"coef": (0.0, 0.0, 0.0, 0.0)}, "coef has 4 numbers: expected 5"),
        ({"coef": (1e200, 0.0, 0.0, 0.0, 0.0)}, "coef is .* expected at most 1e\\+06"),
        ({"robot_from_camera": 1.01 * IDENTITY}, "sensor2World is not a rotation"),
        ({"robot_from_camera": 1e300 * IDENTITY}, "sensor2World is not a rotation"),
        ({"robot_from_camera": 0.0 * IDENTITY}, "sensor2World is not a rotation"),
        ({"robot_from_camera": np.diag([1.0, 1, -1, 0])[:3]}, "sensor2World .* a reflection"),
        ({"robot_from_camera": np.full((3, 4), np.nan)}, "sensor2World has a number that is not"),
        ({"robot_from_camera": np.eye(3)}, r"sensor2World has shape \(3, 3\)"),
        ({"sensor_to_tcp": 1.01 * IDENTITY}, "sensor2Tcp is not a rotation"),
        ({"coef": (0.0, -1.0, 0.0, 0.0, 0.0)}, "the distortion folds inside the image"),
        ({"offset_x": 1e300}, "the distortion folds inside the image"),
        ({"scale_x": 1e-300}, "the distortion folds inside the image"),
    ],
)
def test_what_cannot_be_is_refused_by_name(
    published_camera: Camera, changes: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(CameraError, match=complaint):
        replace(published_camera, **changes)


def test_a_fold_is_inside_exactly_when_a_corner_sees_nothing(published_camera: Camera) -> None:
    # The fold is seen at 1.26803 times the focal length; the farthest corner is pixel (0, 0).
    for factor, possible in ((1.0001, True), (0.9999, False)):
        scale = factor * np.hypot(384.0, 288.0) / 1.268031070
        camera = replace(published_camera, scale_x=scale, scale_y=0.5 * scale)
        assert np.isfinite(camera.undistort([0, 0])).all() == possible
        assert camera.seen_share > 0.999


@pytest.mark.parametrize(("share", "possible"), [(0.55, True), (0.45, False)])
def test_half_of_the_image_must_see_something(
    published_camera: Camera, share: float, possible: bool
) -> None:
    """A distortion that is seen up to a circle which holds that share of the image."""
    half = np.array([published_camera.width - 1, published_camera.height - 1]) / 2.0
    along = np.stack(np.meshgrid(*(np.linspace(-s, s, 801) for s in half * [1.0, 2.0])), axis=-1)
    radius_px = np.quantile(np.hypot(*np.moveaxis(along, -1, 0)), share)
    # x (1 - k r^2) grows up to r = 1 / sqrt(3 k), which is seen at two thirds of that.
    scale = radius_px * 1.5 / math.sqrt(1.0 / (3.0 * 0.2))

    def camera() -> Camera:
        return replace(
            published_camera, scale_x=scale, scale_y=0.5 * scale, offset_x=half[0],
            offset_y=half[1], coef=(0.0,) * 5, polynomial=(-0.2, 0.0, 0.0),
        )  # fmt: skip

    if possible:
        assert camera().seen_share == pytest.approx(share, abs=0.01)
    else:
        with pytest.raises(CameraError, match=r"folds inside .* 4\d % of the image see anything"):
            camera()
