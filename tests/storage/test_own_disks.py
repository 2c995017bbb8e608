"""Results on a disk without hard links, and on a full one: real ones."""

from __future__ import annotations

import errno
import io
import os
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from redetect.storage import write_whole
from tests.storage.own_disks import fill, on_linkless_disk, on_small_disk

OLD = b"what was there before\n"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    folder = tmp_path / "disk"
    folder.mkdir()
    return folder


def passes_here(place: Path, tests: Path) -> None:
    """Links are refused here; all tests of a file pass nevertheless."""
    (place / "file").write_bytes(b"content")
    with pytest.raises(OSError, match="not permitted") as caught:
        os.link(place / "file", place / "link")
    assert caught.value.errno == errno.EPERM
    switches = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    with redirect_stdout(io.StringIO()) as said:
        code = pytest.main([*switches, "--basetemp", str(place / "tests"), str(tests)])
    assert code == 0, said.getvalue()


def test_files_appear_whole_or_not_at_all_without_hard_links(place: Path) -> None:
    on_linkless_disk(place, passes_here, place, Path(__file__).parent / "test_write_whole.py")


def keeps_what_is_there(place: Path) -> None:
    path = place / "result"
    path.write_bytes(OLD)
    filler = fill(place)
    for content in (bytes(1 << 20), b"a few bytes"):
        with pytest.raises(OSError, match="No space left") as caught:
            write(path, content)
        assert caught.value.errno == errno.ENOSPC
        assert caught.value.filename == str(path)
        assert path.read_bytes() == OLD
        assert sorted(p.name for p in place.iterdir()) == ["filler", "result"]
    filler.unlink()
    write(path, b"a few bytes")
    assert path.read_bytes() == b"a few bytes"


def write(path: Path, content: bytes) -> None:
    with write_whole(path, overwrite=True) as stream:
        stream.write(content)


def test_a_full_disk_keeps_what_is_there(place: Path) -> None:
    on_small_disk(place, 256 << 10, keeps_what_is_there, place)
