"""Results appear whole or not at all, and never over what is there."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest

from redetect.storage import OutputExistsError, demand_writable, write_whole


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write_interrupted(path: Path, *, overwrite: bool, by: BaseException) -> None:
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(b"half of the new")
        raise by


def write_outrun(path: Path) -> None:
    """Write a new file while somebody else takes its name."""
    with write_whole(path, overwrite=False) as stream:
        stream.write(b"mine")
        path.write_bytes(b"theirs")


@pytest.fixture
def umask_027() -> Iterator[None]:
    before = os.umask(0o027)
    yield
    os.umask(before)


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_file_appears_only_when_it_is_complete(tmp_path: Path, overwrite: bool) -> None:
    path = tmp_path / "result"
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(b"first half, ")
        stream.flush()
        assert not path.exists()
        stream.write(b"second half")
        assert not path.exists()
    assert path.read_bytes() == b"first half, second half"
    assert names(tmp_path) == ["result"]


def test_the_old_file_stays_readable_until_the_new_one_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "result"
    path.write_bytes(b"old")
    with write_whole(path, overwrite=True) as stream:
        stream.write(b"new")
        stream.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["result"]


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("there", [True, False])
def test_an_exception_leaves_what_was_there_and_nothing_else(
    tmp_path: Path, kind: type[BaseException], there: bool
) -> None:
    path = tmp_path / "result"
    if there:
        path.write_bytes(b"old")
    with pytest.raises(kind):
        write_interrupted(path, overwrite=there, by=kind())
    assert names(tmp_path) == (["result"] if there else [])
    assert not there or path.read_bytes() == b"old"


def test_an_existing_file_is_refused_before_anything_is_computed(tmp_path: Path) -> None:
    path = tmp_path / "result"
    path.write_bytes(b"precious")
    entered = False
    with pytest.raises(OutputExistsError) as caught, write_whole(path, overwrite=False):
        entered = True
    assert not entered
    assert str(caught.value) == f"{path}: exists already: give --force to overwrite it"
    assert path.read_bytes() == b"precious"
    assert names(tmp_path) == ["result"]


def test_a_name_that_was_taken_meanwhile_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "result"
    with pytest.raises(OutputExistsError):
        write_outrun(path)
    assert path.read_bytes() == b"theirs"
    assert names(tmp_path) == ["result"]


def test_of_many_writers_of_a_new_file_one_succeeds(tmp_path: Path) -> None:
    path = tmp_path / "result"
    at_once = Barrier(8, timeout=30)

    def write(content: bytes) -> bytes | None:
        try:
            with write_whole(path, overwrite=False) as stream:
                stream.write(content)
                at_once.wait()
        except OutputExistsError:
            return None
        return content

    contents = [bytes([65 + k]) * 100_000 for k in range(8)]
    with ThreadPoolExecutor(8) as pool:
        written = [content for content in pool.map(write, contents) if content is not None]
    assert written == [path.read_bytes()]
    assert names(tmp_path) == ["result"]


def test_a_link_that_leads_nowhere_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "result"
    path.symlink_to(tmp_path / "absent")
    with pytest.raises(OutputExistsError), write_whole(path, overwrite=False) as stream:
        stream.write(b"mine")
    assert path.is_symlink()
    assert names(tmp_path) == ["result"]


@pytest.mark.parametrize("taken", [False, True])
def test_without_hard_links_files_appear_as_well_and_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taken: bool
) -> None:
    def no_links(source: object, target: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", no_links)
    path = tmp_path / "result"
    if taken:
        with pytest.raises(OutputExistsError):
            write_outrun(path)
    else:
        with write_whole(path, overwrite=False) as stream:
            stream.write(b"mine")
    assert path.read_bytes() == (b"theirs" if taken else b"mine")
    assert names(tmp_path) == ["result"]


@pytest.mark.usefixtures("umask_027")
@pytest.mark.parametrize("overwrite", [False, True])
def test_permissions_follow_the_umask(tmp_path: Path, overwrite: bool) -> None:
    path = tmp_path / "result"
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(b"for the group too")
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert os.umask(0o027) == 0o027  # and the umask is what it was


def test_a_missing_folder_is_an_error_that_names_it(tmp_path: Path) -> None:
    path = tmp_path / "absent" / "result"
    with pytest.raises(FileNotFoundError, match="absent"), write_whole(path, overwrite=False):
        pass
    assert names(tmp_path) == []


def test_a_path_may_be_text_and_relative(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with write_whole("result", overwrite=False) as stream:
        stream.write(b"here")
    assert (tmp_path / "result").read_bytes() == b"here"


def test_a_link_is_written_through(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_bytes(b"old")
    link.symlink_to(target)
    with write_whole(link, overwrite=True) as stream:
        stream.write(b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "target"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="makes a pipe")
def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with (
        pytest.raises(OSError, match="pipe: is a device, pipe or socket"),
        write_whole(pipe, overwrite=True),
    ):
        pass
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


def test_below_a_file_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError):
        demand_writable(tmp_path / "file" / "rows")


def test_standard_output_is_no_name_of_a_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with (
        pytest.raises(OSError, match="expected the name of a file"),
        write_whole(Path("-"), overwrite=False),
    ):
        pass
    assert not list(tmp_path.iterdir())
