"""Tables on disk, so that they are computed once per calibration.

A cached table is a file named by the hash of everything that decides its content. It begins with
the hash of the bytes that follow, so damage of any kind is noticed, and the table computed again.
Files appear whole or not at all, so any number of processes may share a cache. A cache that cannot
be written to is no error: the next run just computes again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np

from camera import Camera
from lut.floor import floor_positions
from lut.outlines import DiscShape, DiscTable, build_disc_table
from lut.verticals import VerticalTable, build_vertical_table
from storage import write_whole

#: Raised with every change of what tables hold or how they are computed.
TABLE_VERSION = 6

Table = TypeVar("Table", DiscTable, VerticalTable)

_log = logging.getLogger("redetect")

_DIGEST_BYTES = hashlib.sha256().digest_size


def cache_folder() -> Path:
    """Where tables are kept: ``$REDETECT_CACHE``, else ``redetect`` in the user's cache folder."""
    chosen = os.environ.get("REDETECT_CACHE")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "redetect"


def cached_disc_table(camera: Camera, shape: DiscShape, folder: Path | None = None) -> DiscTable:
    """The disc table of a camera, from the cache if it is there and sound, else computed and kept.

    Parameters
    ----------
    camera : Camera
        The calibrated camera.
    shape : DiscShape
        Outlines and limits.
    folder : path, optional
        The cache; by default `cache_folder`.

    Returns
    -------
    DiscTable
        Equal to that of `lut.build_disc_table`.

    Raises
    ------
    TableError
        As `lut.build_disc_table`.
    """
    folder = cache_folder() if folder is None else folder
    path = folder / f"discs-{_key(camera, shape)}.table"

    def complete(**fields: Any) -> DiscTable:
        return DiscTable(**fields, floor_xy=floor_positions(camera).astype(np.float32))

    table = _read(path, complete)
    if table is None:
        _log.info("computing the table of discs, once for this calibration")
        table = build_disc_table(camera, shape)
        # The largest part of a table, and computed as soon as it would be read.
        _keep(path, table, without=("floor_xy",))
    return table


def cached_vertical_table(camera: Camera, folder: Path | None = None) -> VerticalTable:
    """The table of verticals of a camera, from the cache or computed, as `cached_disc_table`.

    Parameters
    ----------
    camera : Camera
        The calibrated camera.
    folder : path, optional
        The cache; by default `cache_folder`.

    Returns
    -------
    VerticalTable
        Equal to that of `lut.build_vertical_table`.
    """
    path = (cache_folder() if folder is None else folder) / f"verticals-{_key(camera)}.table"
    table = _read(path, VerticalTable)
    if table is None:
        _log.info("computing the table of verticals, once for this calibration")
        table = build_vertical_table(camera)
        _keep(path, table)
    return table


def _key(camera: Camera, shape: DiscShape | None = None) -> str:
    values = () if shape is None else dataclasses.astuple(shape)
    numbers = [float(value).hex() for value in values]
    parts = [str(TABLE_VERSION), camera.content_hash, *numbers]
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:32]


def _read(path: Path, make: Callable[..., Table]) -> Table | None:
    """The table made of a file's fields; None if there is no file or it is damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, payload = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    if hashlib.sha256(payload).digest() != digest:
        return None
    try:
        with np.load(io.BytesIO(payload), allow_pickle=False) as arrays:
            # Numbers were stored as arrays without dimensions.
            fields = {name: arrays[name] for name in arrays.files}
        return make(**{name: a if a.ndim else a.item() for name, a in fields.items()})
    except (ValueError, KeyError, TypeError, EOFError, OSError, BadZipFile):
        return None


def _keep(path: Path, table: DiscTable | VerticalTable, without: Sequence[str] = ()) -> None:
    buffer = io.BytesIO()
    names = [field.name for field in dataclasses.fields(table) if field.name not in without]
    fields = {name: getattr(table, name) for name in names}
    np.savez(buffer, allow_pickle=False, **fields)
    payload = buffer.getvalue()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_whole(path, overwrite=True) as stream:
            stream.write(hashlib.sha256(payload).digest())
            stream.write(payload)
    except OSError:
        pass
