"""A cache that somebody else could have written to is never trusted, whatever its hashes say."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lut.cache
from camera import Camera
from lut import DiscShape, build_disc_table, build_vertical_table
from lut.cache import (
    cached_disc_table,
    cached_vertical_table,
    disc_table_fits,
    vertical_table_fits,
)

SHAPE = DiscShape(samples=5, border_px=3, far_limit_m_per_px=0.2)


@pytest.fixture
def camera(published_camera: Camera) -> Camera:
    """The published camera at an eighth of its size: tables in milliseconds."""
    return dataclasses.replace(
        published_camera, width=96, height=36, scale_x=464.762 / 8, scale_y=232.381 / 8,
        offset_x=48.0, offset_y=18.0,
    )  # fmt: skip


@pytest.fixture
def poisoned(tmp_path: Path, camera: Camera) -> Path:
    """A cache whose table is sound as far as hashes and ranges can tell, and wrong."""
    folder = tmp_path / "cache"
    table = cached_disc_table(camera, SHAPE, folder)
    (path,) = folder.iterdir()
    # Its first sample is the image's first pixel.
    wrong = dataclasses.replace(table, samples=changed(table.samples, 0, 0))
    assert disc_table_fits(wrong, camera, SHAPE)
    fields = {field.name: getattr(wrong, field.name) for field in dataclasses.fields(wrong)}
    buffer = io.BytesIO()
    np.savez(buffer, **fields)
    payload = buffer.getvalue()
    path.write_bytes(hashlib.sha256(path.name.encode() + b"\0" + payload).digest() + payload)
    assert trusted(camera, path)
    return path


def trusted(camera: Camera, path: Path) -> bool:
    """Whether the poisoned table is used; another one must be the right one."""
    right = build_disc_table(camera, SHAPE).samples
    found = cached_disc_table(camera, SHAPE, path.parent).samples
    return not np.array_equal(found, right)


def test_new_files_and_folders_are_the_user_s_alone(tmp_path: Path, camera: Camera) -> None:
    before = os.umask(0o002)
    try:
        cached_disc_table(camera, SHAPE, tmp_path / "new")
    finally:
        os.umask(before)
    (path,) = (tmp_path / "new").iterdir()
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("mode", [0o620, 0o602, 0o666])
def test_a_file_that_others_can_write_to(
    poisoned: Path, camera: Camera, mode: int, caplog: pytest.LogCaptureFixture
) -> None:
    poisoned.chmod(mode)
    assert not trusted(camera, poisoned)
    assert "can be written to by others" in caplog.text
    assert str(poisoned) in caplog.text
    assert poisoned.stat().st_mode & 0o777 == 0o600  # it was made anew


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o1777])
def test_a_folder_that_others_can_write_to(
    poisoned: Path, camera: Camera, mode: int, caplog: pytest.LogCaptureFixture
) -> None:
    poisoned.parent.chmod(mode)
    assert not trusted(camera, poisoned)
    assert f"cache {poisoned.parent}" in caplog.text


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
@pytest.mark.parametrize("what", [lambda path: path, lambda path: path.parent])
def test_what_belongs_to_somebody_else(
    poisoned: Path, camera: Camera, what: Callable[[Path], Path], caplog: pytest.LogCaptureFixture
) -> None:
    os.chown(what(poisoned), 12345, -1)
    assert not trusted(camera, poisoned)
    assert "belongs to user 12345" in caplog.text


def test_a_link_is_not_followed(poisoned: Path, camera: Camera, tmp_path: Path) -> None:
    elsewhere = poisoned.rename(tmp_path / "elsewhere")
    poisoned.symlink_to(elsewhere)
    assert not trusted(camera, poisoned)


def test_a_pipe_is_not_waited_for(poisoned: Path, camera: Camera) -> None:
    poisoned.unlink()
    os.mkfifo(poisoned)
    assert not trusted(camera, poisoned)


def test_a_table_under_another_s_name(tmp_path: Path, camera: Camera) -> None:
    other = dataclasses.replace(SHAPE, samples=8)
    cached_disc_table(camera, SHAPE, tmp_path)
    (path,) = tmp_path.iterdir()
    stolen = path.read_bytes()
    cached_disc_table(camera, other, tmp_path)
    (second,) = set(tmp_path.iterdir()) - {path}
    second.write_bytes(stolen)
    assert lut.cache._own_content(second) == stolen
    found = cached_disc_table(camera, other, tmp_path)
    np.testing.assert_array_equal(found.samples, build_disc_table(camera, other).samples)


def changed(array: Any, index: Any, value: Any) -> Any:
    copy = array.copy(order="K")
    copy[index] = value
    return copy


DISC_DAMAGE: list[tuple[str, Callable[[Any], Any]]] = [
    ("samples", lambda table: 6),
    ("samples", lambda table: changed(table.samples, 0, 36 * 96 + 1)),
    ("samples", lambda table: table.samples.astype(np.int32)),
    ("samples", lambda table: table.samples[:-4].copy()),
    ("samples", lambda table: table.samples[:, :, :1].copy()),
    ("pixels", lambda table: changed(table.pixels, (0, 1), 36)),
    ("pixels", lambda table: changed(table.pixels, (0, 1), -1)),
    ("pixels", lambda table: table.pixels[:-1].copy()),
    ("pixels", lambda table: changed(table.pixels, (0, 0), 96)),
    ("pixels", lambda table: table.pixels.astype(np.int64)),
    ("floor_xy", lambda table: table.floor_xy[:-1].copy()),
]


@pytest.mark.parametrize(("name", "damage"), DISC_DAMAGE)
def test_impossible_disc_tables(camera: Camera, name: str, damage: Callable[[Any], Any]) -> None:
    table = build_disc_table(camera, SHAPE)
    assert disc_table_fits(table, camera, SHAPE)
    changes: Any = {name: damage(table)}
    assert not disc_table_fits(dataclasses.replace(table, **changes), camera, SHAPE)


VERTICAL_DAMAGE: list[tuple[str, Callable[[Any], Any]]] = [
    ("first_row", lambda table: changed(table.first_row, 48, -1)),
    ("last_row", lambda table: changed(table.last_row, 48, 36)),
    ("last_row", lambda table: changed(table.last_row, 48, table.last_row[48] - 1)),
    ("column", lambda table: changed(table.column, (table.first_row[48], 48), 96.5)),
    ("column", lambda table: changed(table.column, (table.first_row[48], 48), np.nan)),
    ("column", lambda table: np.ascontiguousarray(table.column)),
    ("column", lambda table: table.column[:-1]),
    ("elevation_tan", lambda table: np.full_like(table.elevation_tan, np.nan)),
    ("anchor_row", lambda table: changed(table.anchor_row, 48, 1e9)),
    ("anchor_row", lambda table: changed(table.anchor_row, 48, np.inf)),
    ("bearing_rad", lambda table: changed(table.bearing_rad, 48, np.nan)),
    ("robot_from_camera", lambda table: -table.robot_from_camera),
    ("row_aspect", lambda table: 1.0),
]


@pytest.mark.parametrize(("name", "damage"), VERTICAL_DAMAGE)
def test_impossible_tables_of_verticals(
    camera: Camera, name: str, damage: Callable[[Any], Any], tmp_path: Path
) -> None:
    table = cached_vertical_table(camera, tmp_path)
    assert vertical_table_fits(table, camera)
    assert table.usable[48]
    changes: Any = {name: damage(table)}
    assert not vertical_table_fits(dataclasses.replace(table, **changes), camera)
    np.testing.assert_array_equal(
        cached_vertical_table(camera, tmp_path).column, build_vertical_table(camera).column
    )
