"""A kernel is compiled for one kind of array, wherever tables come from.

Built or read from a file, arrays differ in whether they may be written to and in how they lie in
memory; for each kind Numba would compile again, for seconds, in a user's second run.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from numba import typeof

from camera import Camera
from lut import DiscShape, cached_disc_table, cached_vertical_table
from tools.benchmark.material import scaled_camera


def kinds_of(table: Any) -> dict[str, str]:
    return {
        field.name: str(typeof(getattr(table, field.name))) for field in dataclasses.fields(table)
    }


@pytest.mark.parametrize("kind", ["discs", "verticals"])
def test_tables_that_are_built_and_read_are_of_one_kind(
    published_camera: Camera, tmp_path: Path, kind: str
) -> None:
    def table() -> Any:
        camera = scaled_camera(published_camera, 1 / 8)  # tables in milliseconds
        if kind == "verticals":
            return cached_vertical_table(camera, folder=tmp_path)
        return cached_disc_table(
            camera, DiscShape(samples=5, border_px=3, far_limit_m_per_px=0.2), folder=tmp_path
        )

    built = kinds_of(table())
    assert len(list(tmp_path.iterdir())) == 1
    assert kinds_of(table()) == built
