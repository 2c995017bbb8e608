"""Worlds come back from their files, and the same world is the same bytes."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from redetect.storage import OutputExistsError
from tools.reenactment.world import World, WorldError, read_world, write_world


@pytest.fixture
def world() -> World:
    rng = np.random.default_rng(0)
    return World(
        prefixes=np.array(["run.0000", "run.0001"]),
        poses=rng.normal(size=(2, 3)),
        tilt=rng.normal(size=(2, 2)),
        disc_ids=np.array([3, 5, 5]),
        disc_xy=rng.normal(size=(3, 2)),
        robot_from_camera=rng.normal(size=(3, 4)),
    )


def test_round_trip(tmp_path: Path, world: World) -> None:
    write_world(tmp_path / "w.npz", world)
    back = read_world(tmp_path / "w.npz")
    for field in fields(World):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(world, field.name))
    with np.load(tmp_path / "w.npz", allow_pickle=False) as archive:
        assert set(archive) == {field.name for field in fields(World)}


def test_same_bytes_and_no_silent_overwriting(tmp_path: Path, world: World) -> None:
    write_world(tmp_path / "a.npz", world)
    write_world(tmp_path / "b.npz", world)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with pytest.raises(OutputExistsError):
        write_world(tmp_path / "a.npz", world)


def test_files_that_hold_no_world(tmp_path: Path, world: World) -> None:
    np.savez(tmp_path / "lacking.npz", poses=world.poses)
    with pytest.raises(WorldError, match=r"lacking.npz: .*prefixes"):
        read_world(tmp_path / "lacking.npz")
    (tmp_path / "text.npz").write_text("poses")
    with pytest.raises(WorldError, match=r"text.npz: not a world"):
        read_world(tmp_path / "text.npz")
    np.save(tmp_path / "array.npy", world.poses)
    with pytest.raises(WorldError, match=r"array.npy: not a world"):
        read_world(tmp_path / "array.npy")


def test_arrays_that_do_not_fit_each_other(world: World) -> None:
    with pytest.raises(WorldError, match=r"tilt has shape \(1, 2\): expected \(2, 2\)"):
        replace(world, tilt=world.tilt[:1])
