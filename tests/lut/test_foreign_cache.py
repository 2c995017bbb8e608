"""A cache that somebody else could have written to is never trusted, whatever its hashes say."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import lut.cache
from camera import Camera
from lut import build_disc_table, cached_disc_table
from tests.lut.conftest import SHAPE, archive, signed


@pytest.fixture
def poisoned(tmp_path: Path, camera: Camera) -> Path:
    """A cache whose table is sound as far as its hash can tell, and wrong."""
    folder = tmp_path / "cache"
    table = cached_disc_table(camera, SHAPE, folder)
    (path,) = folder.iterdir()
    # Its first sample is the image's first pixel.
    samples = table.samples.copy()
    samples[0] = 0
    wrong = dataclasses.replace(table, samples=samples)
    fields = {field.name: getattr(wrong, field.name) for field in dataclasses.fields(wrong)}
    path.write_bytes(signed(archive(**fields), path.name))
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
