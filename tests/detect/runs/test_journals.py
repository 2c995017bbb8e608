"""Runs that were interrupted, and what of them `--resume` takes over: nothing that does not fit."""

from __future__ import annotations

import errno
import hashlib
import random
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from detect.cli import main
from detect.runs.plan import FrameRows, FrameTask
from detect.runs.stream import RunFiles
from redetect.storage.parts import PartFile
from tests.detect.interrupted_runs import (
    FRAMES,
    PREVIOUS,
    Captured,
    command,
    hidden,
    journalled,
    results,
    resumed,
)


def journal_of(*records: bytes) -> bytes:
    """Records, each behind the digest of it and all before it."""
    lines, digest = [], hashlib.sha256()
    for record in records:
        digest.update(record)
        lines.append(digest.hexdigest()[:16].encode() + b" " + record + b"\n")
    return b"".join(lines)


class Kept:
    """A run that was interrupted after half of its frames."""

    def __init__(self, run: Path, output: Path) -> None:
        self.run, self.output = run, output
        self.frames = self.interrupt_after(FRAMES // 2)

    def interrupt_after(self, frames: int) -> int:
        add = RunFiles.add

        def interrupted(files: RunFiles, found: Sequence[tuple[FrameTask, FrameRows]]) -> None:
            for frame in found:
                add(files, [frame])
                if journalled(self.output) >= frames:
                    raise KeyboardInterrupt

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(RunFiles, "add", interrupted)
            assert main(command(self.run, self.output)) == 130
        return journalled(self.output)


@pytest.fixture
def kept(run_folder: Path, output: Path) -> Kept:
    return Kept(run_folder, output)


@pytest.fixture
def own(own_run: Path, output: Path) -> Kept:
    return Kept(own_run, output)


def test_an_interrupted_run_is_resumed(
    kept: Kept, undisturbed: dict[str, bytes], capsys: Captured
) -> None:
    assert resumed(kept.run, kept.output, capsys) == kept.frames == FRAMES // 2
    assert results(kept.output) == undisturbed
    assert hidden(kept.output) == set()


@pytest.mark.parametrize("flags", [["--circles.threshold", "0.45"], ["--lines.alpha", "published"]])
def test_other_settings_begin_anew(kept: Kept, capsys: Captured, flags: list[str]) -> None:
    assert main(command(kept.run, kept.output, *flags)) == 3
    expected = results(kept.output)
    Kept(kept.run, kept.output)
    capsys.readouterr()
    assert resumed(kept.run, kept.output, capsys, *flags) == 0
    assert results(kept.output) == expected


def test_another_camera_begins_anew(own: Kept, tmp_path: Path, capsys: Captured) -> None:
    camera = (own.run / "e.cam").read_text().replace("1.50354", "1.51354")
    (own.run / "e.cam").write_text(camera)
    assert main(command(own.run, own.output, "--resume")) == 3
    assert "another camera" in capsys.readouterr().err
    other = tmp_path / "other"
    other.mkdir()
    assert main(command(own.run, other)) == 3
    assert results(own.output) == results(other)


def test_frames_after_one_that_changed_are_done_again(
    own: Kept, tmp_path: Path, capsys: Captured
) -> None:
    """The bad image was mended: its row, and those after it, are those of the run as it is now."""
    bad = own.run / "images" / "e.0011.jpg"
    shutil.copy(own.run / "images" / "e.0003.jpg", bad)
    other = tmp_path / "other"
    other.mkdir()
    assert main(command(own.run, other)) == 0
    capsys.readouterr()
    assert main(command(own.run, own.output, "--resume")) == 0
    assert "11 frames of an unfinished run are reused" in capsys.readouterr().err
    assert results(own.output) == results(other)


def test_a_new_image_in_between_is_seen(own: Kept, tmp_path: Path, capsys: Captured) -> None:
    shutil.copy(own.run / "images" / "e.0003.jpg", own.run / "images" / "e.0005a.jpg")
    other = tmp_path / "other"
    other.mkdir()
    assert main(command(own.run, other)) == 3
    capsys.readouterr()
    assert main(command(own.run, own.output, "--resume")) == 3
    assert "6 frames of an unfinished run are reused" in capsys.readouterr().err
    assert results(own.output) == results(other)


@pytest.mark.parametrize("seed", range(9))
def test_damaged_journals(
    kept: Kept, undisturbed: dict[str, bytes], capsys: Captured, seed: int
) -> None:
    """Torn, changed, or something else altogether: only what is proven to be right is used."""
    chance = random.Random(seed)
    journal = kept.output / ".detected.journal"
    content = bytearray(journal.read_bytes())
    if seed % 3 == 0:
        del content[chance.randrange(len(content)) :]
    elif seed % 3 == 1:
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    else:
        earlier_format = journal_of(b'["ab",[0,1],true]', b'"complete"')
        content = bytearray([b"", b"[" * 100_000, earlier_format][seed // 3])
    journal.write_bytes(content)
    assert resumed(kept.run, kept.output, capsys) <= kept.frames
    assert results(kept.output) == undisturbed
    assert hidden(kept.output) == set()


def test_rows_of_a_journal_that_were_swapped(kept: Kept, undisturbed: dict[str, bytes]) -> None:
    """Each line is in order by itself, but they belong to other frames."""
    journal = kept.output / ".detected.journal"
    lines = journal.read_bytes().splitlines(keepends=True)
    lines[3], lines[4] = lines[4], lines[3]
    journal.write_bytes(b"".join(lines))
    assert main(command(kept.run, kept.output, "--resume")) == 3
    assert results(kept.output) == undisturbed


@pytest.mark.parametrize("name", [".detected.journal", ".detected.lines.part"])
def test_links_in_the_place_of_a_journal_or_part_are_not_followed(
    run_folder: Path, output: Path, tmp_path: Path, undisturbed: dict[str, bytes], name: str
) -> None:
    precious = tmp_path / "precious"
    precious.write_bytes(PREVIOUS)
    (output / name).symlink_to(precious)
    main(command(run_folder, output))
    assert precious.read_bytes() == PREVIOUS
    refused = name == ".detected.journal"  # as if another run had it
    assert results(output) == ({} if refused else undisturbed)


def test_resuming_what_was_never_begun(
    run_folder: Path, output: Path, undisturbed: dict[str, bytes], capsys: Captured
) -> None:
    assert resumed(run_folder, output, capsys) == 0
    assert results(output) == undisturbed


@pytest.mark.parametrize("step", ["sync", "replace"])
def test_results_that_cannot_be_written_are_written_by_the_next_run(
    run_folder: Path, output: Path, undisturbed: dict[str, bytes], capsys: Captured, step: str
) -> None:
    """All frames are done, and then the disk is full, or a file cannot take its place."""
    count = [0]
    plain = getattr(PartFile, step)

    def fail(part: PartFile, *path: Path, **how: bool) -> None:
        count[0] += 1
        if count[0] == 3:
            raise OSError(errno.ENOSPC, "No space left on device", str(part.place))
        plain(part, *path, **how)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PartFile, step, fail)
        assert main(command(run_folder, output)) == 1
    assert "No space left on device: '" in capsys.readouterr().err
    assert ".detected.journal" in hidden(output)
    assert resumed(run_folder, output, capsys) == FRAMES
    assert results(output) == undisturbed
    assert hidden(output) == set()
