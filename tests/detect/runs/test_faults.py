"""One bad frame costs one frame: what rows, summary, log and exit code say of it."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from detect.cli import main
from redetect.landmarks import read_frames, read_steps
from redetect.storage import demand_writable
from tests.detect.commands import Captured
from tests.detect.conftest import SMALL_RUN_DISCS
from tests.detect.runs.claimed_images import SIDE, jpeg, png
from tests.pictures import read_grey

NOBODY = 65534

#: Every way of being bad, and the words that say so.
REASONS = {
    "missing": "no image of that name in the run",
    "empty": "is empty",
    "truncated-jpeg": "truncated",
    "truncated-png": "cannot be decoded",
    "wrong-size": "is 767x288 px: expected 768x288",
    "no-image": "cannot be decoded: expected an image",
    "other-kind": "cannot be decoded: expected an image",
    "folder": "cannot be read: Is a directory",
    "dangling": "cannot be read: No such file",
    "loop": "cannot be read: Too many levels of symbolic links",
    "pipe": "cannot be read: is a pipe",
    "endless": "cannot be read: is a link that leads out of the run",
    "enormous-jpeg": f"claims {SIDE}x{SIDE} px",
    "enormous-png": f"claims {SIDE}x{SIDE} px",
}
#: These are converted: colour to its brightness, 16 bits to 8.
CONVERTED = ("sixteen-bit", "colour")


def encoded(suffix: str, image: Any) -> bytes:
    done, content = cv2.imencode(suffix, image)
    assert done
    return bytes(content.tobytes())


def step_row(prefix: str) -> str:
    return f"STEP {prefix} 0.25 0 0.01 1e-5 0 1e-5 0 0 1e-4\n"


@pytest.fixture
def spoilt_run(small_run: Path) -> Path:
    """A good frame, then one of each kind with the good one after it, then those converted."""
    images = small_run / "images"
    good = images / "s.0000.png"
    grey = read_grey(good)
    contents = {
        "empty.png": b"",
        "truncated-jpeg.jpg": encoded(".jpg", grey)[:9000],
        "truncated-png.png": good.read_bytes()[:30_000],
        "wrong-size.png": encoded(".png", grey[:, :-1]),
        "no-image.jpg": b"<html>404</html>" * 100,
        "other-kind.png": encoded(".webp", grey),
        "enormous-jpeg.jpg": jpeg(SIDE, SIDE),
        "enormous-png.png": png(SIDE, SIDE),
        "sixteen-bit.png": encoded(".png", grey.astype(np.uint16) * 257),
        "colour.png": encoded(".png", np.dstack([grey] * 3)),
    }
    for name, content in contents.items():
        (images / name).write_bytes(content)
    (images / "folder.png").mkdir()
    (images / "dangling.png").symlink_to(images / "gone.png")
    (images / "loop.png").symlink_to(images / "loop.png")
    os.mkfifo(images / "pipe.png")
    (images / "endless.png").symlink_to("/dev/zero")
    rows = [step_row("s.0000")]
    for name in (*REASONS, *CONVERTED):
        rows += [step_row(name), step_row("s.0000")]
    (small_run / "s.txt").write_text("".join(rows))
    return small_run


def log_of(output: Path) -> Any:
    return json.loads(output.with_name(f"{output.name}.log.json").read_text())


def test_without_any_readable_image_nothing_is_said_about_discs(
    small_run: Path, capsys: Captured
) -> None:
    for image in (small_run / "images").iterdir():
        image.write_bytes(b"no image")
    assert main(["circles", str(small_run)]) == 3
    shown = capsys.readouterr().err
    assert "could not be processed" in shown
    assert "disc" not in shown.replace("detected", "")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="makes pipes with names")
def test_bad_frames_cost_themselves(spoilt_run: Path, capsys: Captured) -> None:
    output = spoilt_run / "detected.circles"
    assert main(["circles", str(spoilt_run)]) == 3
    shown = capsys.readouterr().err.splitlines()
    assert f"{len(REASONS)} frames could not be processed:" in shown
    frames = list(read_frames(output))
    assert [frame.step for frame in frames] == list(read_steps(spoilt_run / "s.txt"))
    for frame in frames:
        bad = frame.step.prefix in REASONS
        assert len(frame.circles) == (0 if bad else len(SMALL_RUN_DISCS["s.0000"]))
    good = [frame.circles for frame in frames if frame.step.prefix not in REASONS]
    assert all(circles == good[0] for circles in good)

    log = log_of(output)
    places = {frame.step.prefix: place for place, frame in enumerate(frames)}
    assert [failure["prefix"] for failure in log["failures"]] == list(REASONS)
    for failure in log["failures"]:
        assert failure["frame"] == places[failure["prefix"]]
        assert REASONS[failure["prefix"]] in failure["reason"]
        assert "\n" not in failure["reason"]
    assert (log["exit_code"], log["frames"], log["failed"]) == (3, len(frames), len(REASONS))
    assert log["found"]["discs"] == sum(len(circles) for circles in good)
    assert log["command"] == "circles"
    assert log["settings"]["circles"]["radius_m"] == 0.1


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="makes pipes with names")
def test_every_command_goes_on(spoilt_run: Path) -> None:
    """Verticals, tilt and markers as well; the log of `all` is one for its four files."""
    assert main(["all", str(spoilt_run)]) == 3
    log = json.loads((spoilt_run / "detected.log.json").read_text())
    assert [failure["prefix"] for failure in log["failures"]] == list(REASONS)
    assert main(["markers", str(spoilt_run)]) == 3
    assert len(log_of(spoilt_run / "detected.markers")["failures"]) == len(REASONS)


def test_the_log_of_a_good_run(small_run: Path, tmp_path: Path) -> None:
    logs = []
    for name in ("first", "second"):
        output = tmp_path / name / "rows.circles"
        output.parent.mkdir()
        assert main(["circles", str(small_run), "-o", str(output)]) == 0
        logs.append(output.with_name("rows.circles.log.json").read_bytes())
    assert logs[0] == logs[1]
    log = json.loads(logs[0])
    assert (log["failures"], log["failed"], log["exit_code"], log["frames"]) == ([], 0, 0, 3)


def test_strict_stops_at_the_first_bad_frame(small_run: Path, capsys: Captured) -> None:
    (small_run / "images" / "s.0001.png").write_bytes(b"no image")
    (small_run / "images" / "s.0002.png").unlink()
    before = sorted(path.name for path in small_run.rglob("*"))
    assert main(["all", str(small_run), "--strict"]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    *_, line = shown.err.splitlines()
    assert line.startswith("error: ")
    assert "s.0001.png: cannot be decoded: expected an image: JPEG" in line
    assert "(--strict: nothing is written)" in line
    assert sorted(path.name for path in small_run.rglob("*")) == before


# -- what belongs to others -------------------------------------------------------------------


@contextmanager
def as_nobody() -> Iterator[None]:
    """Be a user who may not do everything: permissions mean nothing to the superuser."""
    superuser = os.geteuid() == 0
    if superuser:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        if superuser:
            os.seteuid(0)


@pytest.mark.parametrize("place", ["rows", "folder/rows", "folder/deeper/rows"])
def test_a_folder_that_may_not_be_written_to_is_told_before_the_work(place: str) -> None:
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o555)
        with as_nobody(), pytest.raises(PermissionError) as told:
            demand_writable(Path(name) / place)
        assert told.value.filename == str(Path(name) / place)
        Path(name).chmod(0o777)
        with as_nobody():
            demand_writable(Path(name) / place)


@pytest.fixture
def public_run(small_run: Path) -> Iterator[Path]:
    """A run that everybody may read."""
    folder = Path(tempfile.mkdtemp())
    run = Path(shutil.copytree(small_run, folder / "s"))
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)
    try:
        with as_nobody():
            reached = os.access(run, os.R_OK, effective_ids=True)
        if not reached:
            pytest.skip("temporary files (TMPDIR) are where no other user may look")
        yield run
    finally:
        run.chmod(0o755)
        shutil.rmtree(folder)


@pytest.mark.skipif(not hasattr(os, "seteuid"), reason="there are no such permissions")
def test_an_image_that_may_not_be_read(public_run: Path) -> None:
    assert main(["circles", str(public_run), "--force"]) == 0  # what is compiled is compiled
    (public_run / "images" / "s.0001.png").chmod(0)
    output = public_run.parent / "rows"
    output.mkdir()
    output.chmod(0o777)
    rows = output / "rows.circles"
    with as_nobody():
        code = main(["circles", str(public_run), "-o", str(rows)])
    assert code == 3
    (failure,) = log_of(rows)["failures"]
    assert failure["prefix"] == "s.0001"
    assert "cannot be read: Permission denied" in failure["reason"]
    assert [len(frame.circles) for frame in read_frames(rows)] == [2, 0, 0]


@pytest.mark.skipif(not hasattr(os, "seteuid"), reason="there are no such permissions")
def test_a_folder_that_may_not_be_written(public_run: Path, capsys: Captured) -> None:
    assert main(["circles", str(public_run)]) == 0
    before = {path: path.read_bytes() for path in public_run.iterdir() if path.is_file()}
    capsys.readouterr()
    (public_run).chmod(0o555)
    with as_nobody():
        code = main(["circles", str(public_run), "--force"])
    assert code == 1
    assert "Permission denied" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in public_run.iterdir() if path.is_file()} == before
