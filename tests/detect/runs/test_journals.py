"""Runs that were interrupted, and what of them `--resume` takes over: nothing that does not fit."""

from __future__ import annotations

import errno
import hashlib
import random
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from detect.cli import main
from detect.runs.plan import FrameRows, FrameTask
from detect.runs.stream import RunFiles
from redetect.storage.parts import PartFile
from tests.detect.interrupted_runs import (
    FRAMES,
    PREVIOUS,
    Trial,
    a_run,
    command,
    journalled,
    results,
)


def journal_of(*records: bytes) -> bytes:
    """Records, each behind the digest of it and all before it."""
    lines, digest = [], hashlib.sha256()
    for record in records:
        digest.update(record)
        lines.append(digest.hexdigest()[:16].encode() + b" " + record + b"\n")
    return b"".join(lines)


def interrupted(run: Path, output: Path) -> None:
    """Interrupt the run after half of its frames."""
    add = RunFiles.add

    def interrupt(files: RunFiles, found: Sequence[tuple[FrameTask, FrameRows]]) -> None:
        for frame in found:
            add(files, [frame])
            if journalled(output) >= FRAMES // 2:
                raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFiles, "add", interrupt)
        assert main(command(run, output)) == 130
    assert journalled(output) == FRAMES // 2


@pytest.fixture(scope="module")
def interrupted_output(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("interrupted")
    interrupted(run_folder, output)
    return output


@pytest.fixture
def kept(trial: Trial, interrupted_output: Path) -> Trial:
    """The run, interrupted after half of its frames."""
    shutil.copytree(interrupted_output, trial.output, dirs_exist_ok=True)
    return trial


@pytest.fixture
def own(trial: Trial, project_root: Path, tmp_path: Path) -> Trial:
    """The same with a run folder that may be changed."""
    run = a_run(project_root, tmp_path / "e")
    interrupted(run, trial.output)
    return replace(trial, run=run)


@pytest.fixture
def other(tmp_path: Path) -> Path:
    """A folder for another run's results."""
    (tmp_path / "other").mkdir()
    return tmp_path / "other"


def test_an_interrupted_run_is_resumed(kept: Trial) -> None:
    assert kept.resumed() == FRAMES // 2
    kept.assert_complete()


@pytest.mark.parametrize("flags", [["--quality-threshold", "0.45"], ["--alpha", "published"]])
def test_other_settings_begin_anew(kept: Trial, other: Path, flags: list[str]) -> None:
    assert main(command(kept.run, other, *flags)) == 3
    assert kept.resumed(*flags) == 0
    assert kept.results() == results(other)


def test_another_camera_begins_anew(own: Trial, other: Path) -> None:
    camera = (own.run / "e.cam").read_text().replace("1.50354", "1.51354")
    (own.run / "e.cam").write_text(camera)
    assert main(own.command("--resume")) == 3
    assert "another camera" in own.said()
    assert main(command(own.run, other)) == 3
    assert own.results() == results(other)


@pytest.mark.parametrize(
    ("name", "reused", "code"),
    [
        ("e.0011.jpg", 11, 0),  # the bad image was mended
        ("e.0005a.jpg", 6, 3),  # one was laid in between
    ],
)
def test_frames_after_one_that_changed_are_done_again(
    own: Trial, other: Path, name: str, reused: int, code: int
) -> None:
    """Its row, and those after it, are those of the run as it is now."""
    shutil.copy(own.run / "images" / "e.0003.jpg", own.run / "images" / name)
    assert main(command(own.run, other)) == code
    own.said()
    assert main(own.command("--resume")) == code
    assert f"{reused} frames of an unfinished run are reused" in own.said()
    assert own.results() == results(other)


@pytest.mark.parametrize("seed", range(9))
def test_damaged_journals(kept: Trial, seed: int) -> None:
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
    assert kept.resumed() <= FRAMES // 2
    kept.assert_complete()


def test_rows_of_a_journal_that_were_swapped(kept: Trial) -> None:
    """Each line is in order by itself, but they belong to other frames."""
    journal = kept.output / ".detected.journal"
    lines = journal.read_bytes().splitlines(keepends=True)
    lines[3], lines[4] = lines[4], lines[3]
    journal.write_bytes(b"".join(lines))
    assert main(kept.command("--resume")) == 3
    assert kept.results() == kept.undisturbed


@pytest.mark.parametrize("name", [".detected.journal", ".detected.lines.part"])
def test_links_in_the_place_of_a_journal_or_part_are_not_followed(
    trial: Trial, tmp_path: Path, name: str
) -> None:
    precious = tmp_path / "precious"
    precious.write_bytes(PREVIOUS)
    (trial.output / name).symlink_to(precious)
    main(trial.command())
    assert precious.read_bytes() == PREVIOUS
    refused = name == ".detected.journal"  # as if another run had it
    assert trial.results() == ({} if refused else trial.undisturbed)


def test_resuming_what_was_never_begun(trial: Trial) -> None:
    assert trial.resumed() == 0
    assert trial.results() == trial.undisturbed


@pytest.mark.parametrize("step", ["sync", "replace"])
def test_results_that_cannot_be_written_are_written_by_the_next_run(
    trial: Trial, step: str
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
        assert main(trial.command()) == 1
    assert "No space left on device: '" in trial.said()
    assert ".detected.journal" in trial.hidden()
    assert trial.resumed() == FRAMES
    trial.assert_complete()
