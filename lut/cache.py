"""Caches tables on disk, so that they are computed once per calibration.

A cached table is a file named by the hash of everything that determines its content. It begins with
a hash of that name and of the bytes that follow, so that damage and renamed files are detected.
Against forgery, only files and folders are used that belong to the user and that no one else can
write to. Rejected tables are computed again, with a warning. Files appear whole or not at all, so
processes may share a cache; one that cannot be written to is not an error. Beyond two gigabytes,
tables that were not used for the longest time are deleted.
"""

from __future__ import annotations

import errno
import hashlib
import io
import logging
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from camera import Camera
from lut.outlines import DiscShape, DiscTable, build_disc_table, fingerprint
from lut.verticals import VerticalTable, build_vertical_table
from lut.votes import VoteShape, VoteTable, build_vote_table
from redetect.storage import write_whole
from redetect.storage.bounded import read_bounded, writable_by_others

#: Incremented with every change of the tables' content or computation.
TABLE_VERSION = 17

Table = TypeVar("Table", DiscTable, VerticalTable, VoteTable)

_log = logging.getLogger("redetect")

_DIGEST_BYTES = hashlib.sha256().digest_size
#: The largest table that is read; that of a 20-megapixel camera has a tenth of this size.
_LARGEST_FILE_BYTES = 1 << 32
#: Size of all tables that are kept.
_LARGEST_CACHE_BYTES = 1 << 31


def cache_folder() -> Path:
    """Folder of the cache: ``$REDETECT_CACHE``, else ``redetect`` in the user's cache folder."""
    chosen = os.environ.get("REDETECT_CACHE")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "redetect"


def cached_disc_table(camera: Camera, shape: DiscShape, folder: Path | None = None) -> DiscTable:
    """The disc table of a camera, from the cache if valid, else computed and cached.

    All else is as for `lut.build_disc_table`; `folder` is the cache, by default `cache_folder`.
    """
    return _cached(DiscTable, "discs", (camera, shape), build_disc_table, folder)


def cached_vote_table(camera: Camera, shape: VoteShape, folder: Path | None = None) -> VoteTable:
    """The table of votes of a camera, as `lut.build_vote_table` computes it; see above."""
    return _cached(VoteTable, "votes", (camera, shape), build_vote_table, folder)


def cached_vertical_table(camera: Camera, folder: Path | None = None) -> VerticalTable:
    """The table of verticals of a camera, as `lut.build_vertical_table` computes it; see above."""
    return _cached(VerticalTable, "verticals", (camera,), build_vertical_table, folder)


def _cached(
    kind: type[Table], name: str, of: tuple[Any, ...], build: Callable[..., Table],
    folder: Path | None,
) -> Table:  # fmt: skip
    content = f"{TABLE_VERSION} {fingerprint(*of).tobytes().hex()}"
    key = hashlib.sha256(content.encode()).hexdigest()[:32]
    path = (folder or cache_folder()) / f"{name}-{key}.table"
    table = _read(path, kind)
    if table is None:
        _log.info("computing the table of %s, once for this calibration", name)
        table = build(*of)
        _keep(path, table)
    return table


def _read(path: Path, kind: type[Table]) -> Table | None:
    """The table in a file; None if there is no file, or it must not be used."""
    content = _own_content(path)
    if content is None:
        return None
    digest, payload = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    with suppress(Exception):  # a damaged or forged archive can raise anything
        if _digest(path, payload) == digest:
            with np.load(io.BytesIO(payload), allow_pickle=False) as arrays:
                found: dict[str, Any] = {name: arrays[name] for name in arrays.files}
            # Numbers were stored as arrays without dimensions.
            return kind(**{name: a if a.ndim else a.item() for name, a in found.items()})
    _log.info("%s: is damaged: computing it again", path)
    return None


def _own_content(path: Path) -> bytes | None:
    """The bytes of a file that only the user can have written; None if there is no such file."""
    try:
        why = writable_by_others(path.parent.stat())
        if why is None:
            return read_bounded(path, _LARGEST_FILE_BYTES, own=True)
        _log.warning("cache %s: %s: its tables are not used", path.parent, why)
    except FileNotFoundError:
        pass
    except OSError as error:
        # A file that changes while it is read counts as damaged, like any other.
        level = logging.INFO if error.errno == errno.EBUSY else logging.WARNING
        _log.log(level, "%s: %s: computing it again", path, error.strerror)
    return None


def _digest(path: Path, payload: bytes) -> bytes:
    """The hash at the beginning of a file: of its name and of the bytes that follow."""
    digest = hashlib.sha256(path.name.encode() + b"\0")
    digest.update(payload)
    return digest.digest()


def _keep(path: Path, table: DiscTable | VerticalTable | VoteTable) -> None:
    buffer = io.BytesIO()
    names = table._fields if isinstance(table, VoteTable) else [f.name for f in fields(table)]
    # NumPy before 2.1 would store `allow_pickle` as an array; all arrays are numeric.
    np.savez(buffer, **{name: getattr(table, name) for name in names})
    payload = buffer.getvalue()
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with write_whole(path, overwrite=True) as stream:
            stream.write(_digest(path, payload))
            stream.write(payload)
        # By default, some users' files are writable by their group.
        path.chmod(0o600)
        _delete_least_recent(path)


def _delete_least_recent(kept: Path) -> None:
    """Delete the tables not used for the longest time, but `kept`, until the cache is small."""
    tables = [(table, table.stat()) for table in kept.parent.glob("*-*.table") if table != kept]
    total = kept.stat().st_size
    # Many file systems record once a day that a file was read, or never.
    tables.sort(key=lambda table: max(table[1].st_atime, table[1].st_mtime), reverse=True)
    for table, state in tables:
        total += state.st_size
        if total > _LARGEST_CACHE_BYTES:
            table.unlink(missing_ok=True)
