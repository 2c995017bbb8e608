"""The cache of tables: what comes out of it is what would have been computed."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lut.cache
from camera import Camera, write_camera
from lut import DiscShape, DiscTable, TableError, build_disc_table, cache_folder, cached_disc_table
from tests.lut.conftest import SHAPE, archive, signed


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[DiscShape]:
    """The shapes for which tables were really computed, in order."""
    shapes: list[DiscShape] = []

    def build(camera: Camera, shape: DiscShape) -> DiscTable:
        shapes.append(shape)
        return build_disc_table(camera, shape)

    monkeypatch.setattr(lut.cache, "build_disc_table", build)
    return shapes


def assert_same(a: DiscTable, b: DiscTable) -> None:
    for field in dataclasses.fields(DiscTable):
        left, right = getattr(a, field.name), getattr(b, field.name)
        assert type(left) is type(right)
        if isinstance(left, np.ndarray):
            assert (left.dtype, left.shape) == (right.dtype, right.shape)
            assert left.tobytes() == right.tobytes()
        else:
            assert left == right


def only_file(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def test_an_empty_table_is_cached_too(
    tmp_path: Path, camera: Camera, computed: list[DiscShape]
) -> None:
    nothing = dataclasses.replace(SHAPE, far_limit_m_per_px=1e-9)
    for _ in range(2):
        assert not cached_disc_table(camera, nothing, tmp_path).usable.any()
    assert computed == [nothing]


def test_the_second_call_computes_nothing(
    tmp_path: Path, camera: Camera, computed: list[DiscShape]
) -> None:
    built = build_disc_table(camera, SHAPE)
    assert_same(cached_disc_table(camera, SHAPE, tmp_path), built)
    before = only_file(tmp_path).read_bytes()
    assert_same(cached_disc_table(camera, SHAPE, tmp_path), built)
    assert computed == [SHAPE]
    assert only_file(tmp_path).read_bytes() == before


def test_equal_cameras_share_a_table_and_what_decides_no_pixel_does_not_matter(
    tmp_path: Path, camera: Camera, computed: list[DiscShape]
) -> None:
    cached_disc_table(camera, SHAPE, tmp_path)
    other = dataclasses.replace(camera, sensor_to_tcp=None, mount_index=7)
    cached_disc_table(other, dataclasses.replace(SHAPE), tmp_path)
    assert computed == [SHAPE]


@pytest.mark.parametrize(
    "changes",
    [
        {"inner_radius_m": 0.061},
        {"outer_radius_m": 0.141},
        {"samples": 6},
        {"border_px": 4},
        {"far_limit_m_per_px": 0.21},
    ],
)
def test_every_setting_has_a_table_of_its_own(
    tmp_path: Path, camera: Camera, computed: list[DiscShape], changes: dict[str, Any]
) -> None:
    other = dataclasses.replace(SHAPE, **changes)
    assert set(changes) <= {field.name for field in dataclasses.fields(DiscShape)}
    cached_disc_table(camera, SHAPE, tmp_path)
    assert_same(cached_disc_table(camera, other, tmp_path), build_disc_table(camera, other))
    assert computed == [SHAPE, other]
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("field", ["width", "scale_x", "offset_y", "coef", "robot_from_camera"])
def test_every_camera_has_a_table_of_its_own(
    tmp_path: Path, camera: Camera, computed: list[DiscShape], field: str
) -> None:
    value: Any = getattr(camera, field)
    if field == "coef":
        value = (*value[:4], value[4] + 1e-6)
    elif field == "robot_from_camera":
        value = (*value[:2], (*value[2][:3], value[2][3] + 1e-6))
    else:
        value += 1
    changes: dict[str, Any] = {field: value}
    other = dataclasses.replace(camera, **changes)
    cached_disc_table(camera, SHAPE, tmp_path)
    assert_same(cached_disc_table(other, SHAPE, tmp_path), build_disc_table(other, SHAPE))
    assert computed == [SHAPE, SHAPE]


def test_another_version_of_the_tables_does_not_read_old_ones(
    tmp_path: Path, camera: Camera, computed: list[DiscShape], monkeypatch: pytest.MonkeyPatch
) -> None:
    cached_disc_table(camera, SHAPE, tmp_path)
    monkeypatch.setattr(lut.cache, "TABLE_VERSION", lut.cache.TABLE_VERSION + 1)
    cached_disc_table(camera, SHAPE, tmp_path)
    assert computed == [SHAPE, SHAPE]


# -- damage ---------------------------------------------------------------------------------------


class Dangerous:
    """Raises if anybody unpickles it."""

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return (pytest.fail, ("unpickled a file of the cache",))


def archive_of_version(version: int) -> bytes:
    """An archive that says it needs a program that there is not."""
    content = archive(samples=np.array(5))
    place = content.index(b"PK\x01\x02") + 6
    return content[:place] + bytes([version]) + content[place + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content, name: b"",
        lambda content, name: content[:10],
        lambda content, name: content[: len(content) // 2],
        lambda content, name: content[:-1],
        lambda content, name: content + b"\0",
        lambda content, name: bytes([content[0] ^ 1]) + content[1:],
        lambda content, name: content[:2000] + bytes([content[2000] ^ 128]) + content[2001:],
        lambda content, name: content[:-1] + bytes([content[-1] ^ 1]),
        lambda content, name: content[32:],
        lambda content, name: pickle.dumps(Dangerous()),
        lambda content, name: signed(b"", name),
        lambda content, name: signed(b"no archive", name),
        lambda content, name: signed(pickle.dumps(Dangerous()), name),
        lambda content, name: signed(archive(samples=np.array([Dangerous()], dtype=object)), name),
        lambda content, name: signed(archive(samples=np.array(5), copies=np.zeros(3)), name),
        lambda content, name: signed(archive(unheard_of=np.zeros(3)), name),
        lambda content, name: signed(archive(samples=np.zeros(3), copies=np.zeros(3)), name),
        lambda content, name: signed(archive_of_version(97), name),
    ],
)
def test_damage_of_any_kind_is_noticed_and_repaired(
    tmp_path: Path,
    camera: Camera,
    computed: list[DiscShape],
    damage: Callable[[bytes, str], bytes],
    caplog: pytest.LogCaptureFixture,
) -> None:
    built = cached_disc_table(camera, SHAPE, tmp_path)
    path = only_file(tmp_path)
    sound = path.read_bytes()
    damaged = damage(sound, path.name)
    assert damaged != sound
    path.write_bytes(damaged)
    # That a table is computed may be told, whatever level other tests have left; no warning yet.
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []
    assert_same(cached_disc_table(camera, SHAPE, tmp_path), built)
    assert computed == [SHAPE, SHAPE]
    assert path.read_bytes() == sound
    cached_disc_table(camera, SHAPE, tmp_path)
    assert computed == [SHAPE, SHAPE]


def test_a_folder_in_the_place_of_the_file_does_no_harm(tmp_path: Path, camera: Camera) -> None:
    cached_disc_table(camera, SHAPE, tmp_path)
    path = only_file(tmp_path)
    path.unlink()
    path.mkdir()
    for _ in range(2):
        assert_same(cached_disc_table(camera, SHAPE, tmp_path), build_disc_table(camera, SHAPE))
    assert only_file(tmp_path) == path  # no temporary files left behind either


# -- where ----------------------------------------------------------------------------------------


def test_tables_not_used_for_the_longest_time_are_deleted(
    tmp_path: Path, camera: Camera, computed: list[DiscShape], monkeypatch: pytest.MonkeyPatch
) -> None:
    shapes = [dataclasses.replace(SHAPE, far_limit_m_per_px=0.1 + 0.001 * k) for k in range(4)]
    for age, shape in zip((30, 20, 10), shapes, strict=False):
        before = set(tmp_path.iterdir())
        cached_disc_table(camera, shape, tmp_path)
        (path,) = set(tmp_path.iterdir()) - before
        # The first was read lately, the others only written.
        written = time.time() - 3600.0 * age
        os.utime(path, (time.time() if age == 30 else written, written))
    other = tmp_path / "notes.txt"
    other.write_bytes(bytes(1000))
    size = max(path.stat().st_size for path in tmp_path.glob("*.table"))
    monkeypatch.setattr(lut.cache, "_LARGEST_CACHE_BYTES", int(2.5 * size))
    cached_disc_table(camera, shapes[3], tmp_path)
    assert len(list(tmp_path.glob("*.table"))) == 2
    assert other.exists()
    computed.clear()
    for shape in (shapes[0], shapes[3]):
        cached_disc_table(camera, shape, tmp_path)
    assert computed == []


def test_a_table_larger_than_the_cache_is_kept(
    tmp_path: Path, camera: Camera, computed: list[DiscShape], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lut.cache, "_LARGEST_CACHE_BYTES", 1)
    for _ in range(2):
        cached_disc_table(camera, SHAPE, tmp_path)
    assert computed == [SHAPE]


def test_a_cache_that_cannot_be_written_to_is_no_error(
    tmp_path: Path, camera: Camera, computed: list[DiscShape]
) -> None:
    (tmp_path / "file").write_bytes(b"not a folder")
    for _ in range(2):
        table = cached_disc_table(camera, SHAPE, tmp_path / "file" / "cache")
        assert_same(table, build_disc_table(camera, SHAPE))
    assert computed == [SHAPE, SHAPE]


def test_a_full_disk_is_no_error(
    tmp_path: Path, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: object, *, overwrite: bool) -> object:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(lut.cache, "write_whole", full)
    built = build_disc_table(camera, SHAPE)
    assert_same(cached_disc_table(camera, SHAPE, tmp_path), built)


def test_folders_are_made(tmp_path: Path, camera: Camera) -> None:
    cached_disc_table(camera, SHAPE, tmp_path / "a" / "b")
    assert only_file(tmp_path / "a" / "b").suffix == ".table"


def test_the_environment_says_where(
    tmp_path: Path, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("REDETECT_CACHE", str(tmp_path / "chosen"))
    assert cache_folder() == tmp_path / "chosen"
    cached_disc_table(camera, SHAPE)
    assert [path.name for path in tmp_path.iterdir()] == ["chosen"]
    monkeypatch.delenv("REDETECT_CACHE")
    assert cache_folder() == tmp_path / "xdg" / "redetect"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "redetect"


def test_an_impossible_camera_is_refused_and_nothing_kept(tmp_path: Path, camera: Camera) -> None:
    pose = camera.robot_from_camera
    below = dataclasses.replace(camera, robot_from_camera=(*pose[:2], (*pose[2][:3], -1.0)))
    with pytest.raises(TableError, match="above the floor"):
        cached_disc_table(below, SHAPE, tmp_path)
    assert list(tmp_path.iterdir()) == []


WRITER = """
import hashlib, sys, time
from pathlib import Path
import lut.cache
from camera import read_camera
from lut import DiscShape, build_disc_table, cached_disc_table

folder, rounds = Path(sys.argv[1]), int(sys.argv[3])
camera = read_camera(sys.argv[2])
shape = DiscShape(samples=5, border_px=3, far_limit_m_per_px=0.2)
build_disc_table(camera, shape)
(folder / f"ready{sys.argv[4]}").touch()
while not (folder / "go").exists():
    time.sleep(0.001)
digests = set()
for _ in range(rounds):
    table = cached_disc_table(camera, shape, folder / "cache")
    digests.add(hashlib.sha256(table.samples.tobytes() + table.floor_xy.tobytes()).hexdigest())
    # Half of the time somebody clears the cache or damages it.
    for path in (folder / "cache").glob("*.table"):
        if sys.argv[4] == "0":
            path.unlink(missing_ok=True)
        elif sys.argv[4] == "1":
            path.write_bytes(b"damaged")
print(*digests)
"""


@pytest.mark.long
def test_concurrent_writers_all_get_right_tables(
    tmp_path: Path, camera: Camera, project_root: Path
) -> None:
    built = build_disc_table(camera, SHAPE)
    right = hashlib.sha256(built.samples.tobytes() + built.floor_xy.tobytes()).hexdigest()
    write_camera(camera, tmp_path / "e.cam")
    places = [str(tmp_path), str(tmp_path / "e.cam")]
    program = [sys.executable, "-W", "error", "-c", WRITER, *places, "40"]
    pipe = subprocess.PIPE
    processes = [
        subprocess.Popen([*program, f"{k}"], cwd=project_root, stdout=pipe, stderr=pipe, text=True)
        for k in range(4)
    ]
    while not all((tmp_path / f"ready{k}").exists() for k in range(4)):
        assert all(process.poll() is None for process in processes), "a writer died at its start"
        time.sleep(0.01)
    (tmp_path / "go").touch()
    for process in processes:
        out, err = process.communicate(timeout=600)
        assert err == ""
        assert process.returncode == 0
        assert out.split() == [right]
    # Nobody left anything unfinished behind.
    assert all(path.suffix == ".table" for path in (tmp_path / "cache").iterdir())
