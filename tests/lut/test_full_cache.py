"""A cache of tables on a disk that is full: a real one."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

import numpy as np

from camera import Camera
from lut import build_disc_table, build_vertical_table
from lut.cache import cached_disc_table, cached_vertical_table
from tests.lut.conftest import SHAPE
from tests.storage.own_disks import fill, on_small_disk


class Said(logging.Handler):
    """What the program says meanwhile."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def tables_are_right(camera: Camera, folder: Path) -> None:
    discs, verticals = cached_disc_table(camera, SHAPE, folder), build_vertical_table(camera)
    np.testing.assert_array_equal(discs.samples, build_disc_table(camera, SHAPE).samples)
    found = cached_vertical_table(camera, folder)
    for field in dataclasses.fields(verticals):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(verticals, field.name))


def costs_time_only(place: Path, camera: Camera) -> None:
    folder = place / "cache"
    folder.mkdir(mode=0o700)
    for room in (0, 4096):  # none at all, and less than a table needs
        filler = fill(place)
        with filler.open("r+b") as stream:
            stream.truncate(filler.stat().st_size - room)
        tables_are_right(camera, folder)
        assert list(folder.iterdir()) == []
        filler.unlink()
    tables_are_right(camera, folder)  # there is room again: they are kept
    assert len(list(folder.iterdir())) == 2
    said = Said()
    logging.getLogger("redetect").addHandler(said)
    logging.getLogger("redetect").setLevel(logging.INFO)
    fill(place)
    tables_are_right(camera, folder)
    assert said.lines == []


def test_no_room_for_tables_costs_time_only(tmp_path: Path, camera: Camera) -> None:
    place = tmp_path / "disk"
    place.mkdir()
    on_small_disk(place, 1 << 20, costs_time_only, place, camera)
