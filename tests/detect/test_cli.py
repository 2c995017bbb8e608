"""The command line: what it prints, writes and exits with."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from detect.cli import main
from redetect.landmarks import read_frames
from tests.detect.commands import Captured, assert_refused, files_in, output_of
from tests.detect.conftest import SMALL_RUN_DISCS
from tests.pictures import changed, read_grey


def settings_of(output: Path) -> dict[str, str]:
    (line,) = [text for text in output.read_text().splitlines() if text.startswith("# settings ")]
    return dict(word.split("=") for word in line.split()[2:])


# -- circles --------------------------------------------------------------------------------


def test_flat_folder_and_named_files(small_run: Path, tmp_path: Path) -> None:
    flat = tmp_path / "flat"
    (small_run / "images").rename(flat)
    output = tmp_path / "rows.circles"
    arguments = ["circles", str(flat), "--camera", str(small_run / "s.cam"), "-o", str(output)]
    assert main(arguments) == 0
    assert [len(frame.circles) for frame in read_frames(output)] == [2, 1, 0]
    assert not (flat / "detected.circles").exists()


def test_settings_are_flags(small_run: Path) -> None:
    assert main(["circles", str(small_run), "--polarity", "dark", "--threshold", "0.5"]) == 0
    output = small_run / "detected.circles"
    assert settings_of(output)["polarity"] == "dark"
    assert settings_of(output)["threshold"] == "0.5"
    assert all(frame.circles == () for frame in read_frames(output))


@pytest.mark.parametrize("preset", [["--preset", "published"], ["--preset=published"]])
def test_published_preset(small_run: Path, preset: list[str]) -> None:
    from dataclasses import asdict

    from detect.settings import PUBLISHED

    assert main(["circles", str(small_run), *preset]) == 0
    written = settings_of(small_run / "detected.circles")
    assert written == {name: str(value) for name, value in asdict(PUBLISHED).items()}
    assert len(next(iter(read_frames(small_run / "detected.circles"))).circles) > 1


@pytest.mark.parametrize("first", [True, False])
def test_flags_override_the_preset(small_run: Path, first: bool) -> None:
    preset, flag = ["--preset", "published"], ["--threshold", "0.95", "--separation", "1.5"]
    arguments = [*flag, *preset] if first else [*preset, *flag]
    assert main(["circles", str(small_run), *arguments]) == 0
    written = settings_of(small_run / "detected.circles")
    assert (written["threshold"], written["separation"]) == ("0.95", "1.5")
    assert (written["refine"], written["noise_floor"]) == ("False", "0.0")
    counts = [len(frame.circles) for frame in read_frames(small_run / "detected.circles")]
    assert counts == [2, 1, 0]


def test_json_and_drawings(small_run: Path, tmp_path: Path) -> None:
    drawings, as_json = tmp_path / "new" / "drawings", tmp_path / "rows.json"
    arguments = ["circles", str(small_run), "--draw", str(drawings), "--json", str(as_json)]
    assert main(arguments) == 0
    frames = json.loads(as_json.read_text())["frames"]
    assert [len(frame["discs"]) for frame in frames] == [2, 1, 0]
    assert sorted(path.name for path in drawings.iterdir()) == [f"{p}.png" for p in SMALL_RUN_DISCS]
    for frame in frames:
        name = f"{frame['frame']}.png"
        image = read_grey(small_run / "images" / name)
        drawn = cv2.imread(str(drawings / name), cv2.IMREAD_COLOR)
        assert drawn is not None
        # The picture is twice as large as the image; words follow below it.
        marked = changed(np.asarray(drawn[: 2 * len(image)], np.uint8), image)
        assert marked.any() == bool(frame["discs"])
        for disc in frame["discs"]:
            u, v = 2 * disc["pixel"][0], 2 * disc["pixel"][1]
            around = slice(v - 80, v + 82), slice(u - 120, u + 182)
            assert marked[around].sum() > 200
            marked[around] = False
        assert not marked.any()


def test_long_lists_of_bad_images_are_cut(small_run: Path, capsys: Captured) -> None:
    (small_run / "s.txt").unlink()
    for number in range(14):
        (small_run / "images" / f"z{number}.png").touch()
    assert main(["markers", str(small_run)]) == 3
    lines = capsys.readouterr().err.splitlines()
    assert "14 frames could not be processed:" in lines
    assert sum("is empty" in line for line in lines) == 10
    assert lines[-1] == "  and 4 more"


def test_images_without_step_are_told(small_run: Path, capsys: Captured) -> None:
    rows = (small_run / "s.txt").read_text().splitlines()
    (small_run / "s.txt").write_text("\n".join(rows[:-1]) + "\n")
    assert main(["circles", str(small_run)]) == 0
    assert "1 images are not named by a STEP row" in capsys.readouterr().out
    (small_run / "s.txt").write_text("# no row\n")
    assert main(["circles", str(small_run), "--force"]) == 1
    assert (
        "images are not named by a STEP row: left out, and none remain" in capsys.readouterr().err
    )


def test_missing_named_calibration(small_run: Path, capsys: Captured) -> None:
    arguments = ["circles", str(small_run), "--camera", str(small_run / "t.cam")]
    assert_refused(arguments, small_run, "t.cam", capsys)


def test_malformed_calibration(small_run: Path, capsys: Captured) -> None:
    text = (small_run / "s.cam").read_text()
    (small_run / "s.cam").write_text(text.replace("width: 768", "width: wide"))
    line = assert_refused(["circles", str(small_run)], small_run, "s.cam", capsys)
    assert "width" in line


@pytest.mark.parametrize(
    ("row", "told"),
    [
        ("STEP s.0003 0.1 0.2\n", "s.txt:5"),
        ("STEP s.0003 0.1 0.2 x 0 0 0 0 0 0\n", "s.txt:5"),
        ("STEP s.0003 nan 0.2 0 0 0 0 0 0 0\n", "s.txt:5"),
        ("NONSENSE 1 2 3\n", "s.txt:5"),
    ],
)
def test_malformed_odometry(small_run: Path, capsys: Captured, row: str, told: str) -> None:
    with (small_run / "s.txt").open("a") as stream:
        stream.write(row)
    assert_refused(["circles", str(small_run)], small_run, told, capsys)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["circles", "RUN", "-o", "RUN/precious"], "precious"),
        (["circles", "RUN", "--json", "RUN/precious"], "precious"),
        (["circles", "RUN"], "detected.circles.log.json"),
        (["lines", "RUN"], "detected.tilt"),
    ],
)
def test_existing_output_stays(
    small_run: Path, capsys: Captured, arguments: list[str], name: str
) -> None:
    precious = small_run / name
    precious.write_text("precious")
    words = [word.replace("RUN", str(small_run)) for word in arguments]
    line = assert_refused(words, small_run, f"{precious}: exists already", capsys)
    assert "--force" in line
    assert main([*words, "--force"]) == 0
    assert precious.read_text() != "precious"


def test_existing_drawings_stay(small_run: Path, tmp_path: Path, capsys: Captured) -> None:
    drawings = tmp_path / "drawings"
    drawings.mkdir()
    (drawings / "s.0001.png").write_text("precious")
    assert main(["circles", str(small_run), "--draw", str(drawings)]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: ")
    assert "s.0001.png" in last
    assert (drawings / "s.0001.png").read_text() == "precious"


@pytest.mark.parametrize("flag", ["-o", "--json"])
def test_outputs_into_no_folder(small_run: Path, capsys: Captured, flag: str) -> None:
    before = files_in(small_run)
    assert main(["circles", str(small_run), flag, str(small_run / "none" / "rows")]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: ")
    assert str(small_run / "none") in last
    assert files_in(small_run) == before


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["circles", "RUN", "-o", "X/rows", "--json", "X/rows"], "rows: named for two results"),
        (["circles", "RUN", "-o", "X/rows", "--json", "X/./rows"], "rows: named for two results"),
        (["circles", "RUN", "-o", "X/r", "--json", "X/r.log.json"], "r.log.json: named for two"),
        (["lines", "RUN", "-o", "X/rows.tilt"], "rows.tilt: named for two results"),
        (["circles", "RUN", "-o", ""], "is a folder: expected an output file"),
        (["lines", "RUN", "-o", "."], "is a folder: expected an output file"),
        (["all", "RUN", "-o", "RUN/s.cam"], "s.cam: is not a folder"),
        (["circles", "RUN", "-o", "X/rows", "--draw", "RUN/s.cam"], "s.cam: is not a folder"),
        (["circles", "RUN", "-o", "X/rows", "--draw", "RUN/s.cam/x"], "s.cam: is not a folder"),
    ],
)
@pytest.mark.parametrize("force", [(), ("--force",)])
def test_places_where_nothing_can_be_written(
    small_run: Path,
    tmp_path: Path,
    capsys: Captured,
    arguments: list[str],
    told: str,
    force: tuple[str, ...],
) -> None:
    (tmp_path / "new").mkdir()
    places = {"RUN": str(small_run), "X": str(tmp_path / "new")}
    words = ["/".join(places.get(part, part) for part in word.split("/")) for word in arguments]
    before = files_in(tmp_path)
    assert main([*words, *force]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    last = shown.err.splitlines()[-1]  # tables and kernels may be made first
    assert last.startswith("error: ")
    assert told in last
    assert files_in(tmp_path) == before


@pytest.mark.parametrize("force", [(), ("--force",)])
@pytest.mark.parametrize("flag", ["-o", "--json"])
@pytest.mark.parametrize("name", ["null", "pipe"])
def test_what_is_no_regular_file_is_refused(
    small_run: Path, capsys: Captured, name: str, flag: str, force: tuple[str, ...]
) -> None:
    """Before any work is done, and also with `--force`."""
    path = Path("/dev/null")
    if name == "pipe":
        path = small_run.parent / "pipe"
        os.mkfifo(path)
    line = assert_refused(
        ["circles", str(small_run), flag, str(path), *force], small_run, "", capsys
    )
    assert f"{path}: is a device, pipe or socket: expected the name of a file" in line
    assert not path.is_file()


def test_two_links_to_one_file(small_run: Path, tmp_path: Path, capsys: Captured) -> None:
    for name in ("one", "two"):
        (tmp_path / name).symlink_to(tmp_path / "rows")
    arguments = ["circles", str(small_run), "-o", str(tmp_path / "one"), "--force"]
    assert main([*arguments, "--json", str(tmp_path / "two")]) == 1
    assert "named for two results" in capsys.readouterr().err
    assert not (tmp_path / "rows").exists()


@pytest.mark.parametrize("there", [True, False])
def test_a_link_is_written_through(small_run: Path, tmp_path: Path, there: bool) -> None:
    """It stays a link; its target, in another folder, is replaced whole."""
    (tmp_path / "elsewhere").mkdir()
    target, link = tmp_path / "elsewhere" / "rows.circles", tmp_path / "link.circles"
    if there:
        target.write_text("what was there before")
    link.symlink_to(target)
    assert main(["circles", str(small_run), "-o", str(link)]) == 1
    assert target.exists() == there
    assert main(["circles", str(small_run), "-o", str(link), "--force"]) == 0
    assert link.is_symlink()
    assert len(list(read_frames(target))) == 3
    assert [path.name for path in target.parent.iterdir()] == ["rows.circles"]
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    "wrong",
    [
        ["circles"],
        [],
        ["squares", "RUN"],
        ["circles", "RUN", "--nonsense"],
        ["circles", "RUN", "--preset", "best"],
        ["circles", "RUN", "--threshold", "high"],
        ["circles", "RUN", "--threshold", "0"],
        ["circles", "RUN", "--threshold", "nan"],
        ["circles", "RUN", "--separation", "-1"],
        ["circles", "RUN", "--polarity", "grey"],
        ["compare", "RUN", "--gate-m", "0"],
    ],
)
def test_wrong_command_lines(small_run: Path, capsys: Captured, wrong: list[str]) -> None:
    before = files_in(small_run)
    with pytest.raises(SystemExit) as end:
        main([str(small_run) if word == "RUN" else word for word in wrong])
    assert end.value.code == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err != ""
    assert files_in(small_run) == before


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (["circles", "images/e", "--radius-m", "-1"], "--radius-m is -1: expected above 0"),
        (["lines", "images/e", "--join-threshold", "-0.1"], "--join-threshold is -0.1: expected 0"),
        (["compare", "images/e", "--gate-m", "0"], "--gate-m is 0: expected above 0"),
        (["export", "map.circles", "--rate-hz", "0"], "--rate-hz is 0: expected above 0"),
    ],
)
def test_a_setting_out_of_its_bounds_is_one_line(
    capsys: Captured, wrong: list[str], said: str
) -> None:
    with pytest.raises(SystemExit) as end:
        main(wrong)
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {said}")


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["lines", "RUN", "--rejected"], "--rejected: expected a folder"),
        (["markers", "RUN", "--rejected"], "--rejected: expected a folder"),
        (["circles", "RUN", "--wheel-base-m", "0.3"], "--odometry FILE.ticks"),
        (["circles", "RUN", "--bit-depth", "12"], "expected images whose values are stored in 16"),
        (["draw", "RUN", "-o", "RUN/pictures", "--fps", "5"], "--fps: expected a video"),
        (
            ["compare", "RUN", "--lines", "--camera", "gone.cam"],
            "--camera, --gate-m: expected discs",
        ),
        (["compare", "RUN", "--lines", "--gate-m", "0.1"], "--camera, --gate-m: expected discs"),
    ],
)
def test_a_flag_without_effect_is_refused(
    small_run: Path, capsys: Captured, flags: list[str], said: str
) -> None:
    words = [word.replace("RUN", str(small_run)) for word in flags]
    assert_refused(words, small_run, said, capsys)


def test_refused_settings_are_named(small_run: Path, capsys: Captured) -> None:
    with pytest.raises(SystemExit):
        main(["circles", str(small_run), "--threshold", "1.5"])
    assert "threshold is 1.5" in capsys.readouterr().err


# -- compare --------------------------------------------------------------------------------


@pytest.fixture
def compared_run(small_run: Path, capsys: Captured) -> Path:
    """Of four reference rows three are found, and nothing else."""
    assert main(["circles", str(small_run)]) == 0
    reference = (small_run / "detected.circles").read_text()
    (small_run / "map.circles").write_text(reference + "LANDMARK_C 1 -3 0.9 0.002 0 0.003 7\n")
    capsys.readouterr()
    return small_run


@pytest.mark.parametrize(
    ("demands", "code", "unmet"),
    [
        ([], 0, 0),
        (["--min-recall", "0.75"], 0, 0),
        (["--min-recall", "0.76"], 1, 1),
        (["--min-precision", "1.0"], 0, 0),
        (["--min-recall", "0.7", "--min-precision", "1"], 0, 0),
        (["--min-recall", "0.9", "--min-precision", "1"], 1, 1),
    ],
)
def test_demands_decide_the_exit_code(
    compared_run: Path, capsys: Captured, demands: list[str], code: int, unmet: int
) -> None:
    assert main(["compare", str(compared_run), *demands]) == code
    shown = capsys.readouterr()
    lines = shown.err.splitlines()
    assert len(lines) == unmet
    assert all(line.startswith("recall is 0.7500: expected at least 0.") for line in lines)
    assert "0.75" in shown.out or "75" in shown.out


@pytest.mark.parametrize("least", ["nan", "75"])
def test_demands_are_shares(compared_run: Path, capsys: Captured, least: str) -> None:
    with pytest.raises(SystemExit):
        main(["compare", str(compared_run), "--min-recall", least])
    assert f"--min-recall is {least}: expected 0 to 1" in " ".join(capsys.readouterr().err.split())


def test_comparison_as_json(compared_run: Path, tmp_path: Path) -> None:
    as_json = tmp_path / "result.json"
    assert main(["compare", str(compared_run), "--json", str(as_json)]) == 0
    result = json.loads(as_json.read_text())
    assert (result["reference"], result["detected"], result["matched"]) == (4, 3, 3)
    assert (result["recall"], result["precision"]) == (0.75, 1.0)


def test_nothing_to_compare(small_run: Path, capsys: Captured) -> None:
    assert_refused(["compare", str(small_run)], small_run, "map.circles", capsys)


def test_malformed_reference(compared_run: Path, capsys: Captured) -> None:
    with (compared_run / "map.circles").open("a") as stream:
        stream.write("LANDMARK_C 1 2 3\n")
    line_count = len((compared_run / "map.circles").read_text().splitlines())
    arguments = ["compare", str(compared_run)]
    assert_refused(arguments, compared_run, f"map.circles:{line_count}", capsys)


# -- help -----------------------------------------------------------------------------------


def test_help_needs_nothing_heavy() -> None:
    program = (
        "import sys\n"
        "from detect.cli import main\n"
        "for command in ([], ['circles'], ['compare']):\n"
        "    try:\n"
        "        main([*command, '--help'])\n"
        "    except SystemExit as end:\n"
        "        assert end.code == 0\n"
        "print({'numba', 'cv2', 'scipy', 'skimage', 'pycolmap'} & set(sys.modules))\n"
    )
    shown = output_of(program)
    assert shown.splitlines()[-1] == "set()"
    for word in ("circles", "compare", "--preset", "--radius-m", "--min-recall", "--reference"):
        assert word in shown


@pytest.mark.parametrize("help_flag", ["--help", "--help-all"])
def test_help_has_the_defaults_of_the_preset(help_flag: str, capsys: Captured) -> None:
    with pytest.raises(SystemExit):
        main(["circles", "--preset", "published", help_flag])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    calibration = text.partition("--calibration-px FLOAT")[2].partition(" --")[0]
    assert "(default: 0.0)" in calibration
