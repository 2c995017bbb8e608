"""`redetect`: one program, quiet if told, with an answer to what is mistyped."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import cv2
import pytest

from detect.commands.report import DEMO_RUN
from redetect.cli import DIRECT, PROGRAMS, main
from tools.demo_package import FRAMES, first_frames

Captured = pytest.CaptureFixture[str]


def refused(words: list[str], captured: Captured) -> str:
    """What is said to a wrong command line: one line, exit code 2."""
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    shown = captured.readouterr()
    assert shown.out == ""
    (line,) = shown.err.splitlines()
    return line


def test_help_names_every_command(capsys: Captured) -> None:
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    for name, module in PROGRAMS.items():
        assert f"{name} {{{','.join(import_module(module).PROGRAM.commands)}}}" in shown
    for name in DIRECT:
        assert f"\n  {name} " in shown
    assert main([]) == 2
    assert main(["--version"]) == 0


def test_it_starts_without_anything_heavy(project_root: Path) -> None:
    program = (
        "import sys\n"
        "from redetect.cli import main\n"
        "main(['--help'])\n"
        "print({'numba', 'cv2', 'scipy', 'skimage', 'pycolmap'} & set(sys.modules))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=project_root, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == "set()"


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        ("detct all RUN", "no command 'detct': did you mean detect?"),
        ("comapre RUN", "no command 'comapre': did you mean compare?"),
        ("circles RUN", "did you mean redetect detect circles?"),
        ("calibrate RUN", "did you mean redetect camera calibrate?"),
        ("zzz", "one of camera, compare"),
        ("detect circels RUN", "detect: no command 'circels': did you mean circles?"),
        ("groundtruth pose RUN", "did you mean poses?"),
    ],
)
def test_mistyped_words_are_answered_with_the_nearest(
    words: str, answer: str, capsys: Captured
) -> None:
    assert answer in refused(words.split(), capsys)


@pytest.mark.parametrize(
    ("words", "flag"),
    [
        ("detect circles RUN --quality-thresold 0.4", "--quality-threshold"),
        ("detect all RUN --radus-m=1", "--radius-m"),
        ("slam map RUN --calibrte", "--calibrate"),
        ("camera convert a b --limit 1", "--limit-px"),
        ("explain IMAGE --polaritty dark", "--polarity"),
    ],
)
def test_mistyped_flags_are_answered_with_near_ones(
    words: str, flag: str, capsys: Captured
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words.split())
    assert flag in capsys.readouterr().err


def test_help_has_the_common_flags_and_help_all_has_all(capsys: Captured) -> None:
    with pytest.raises(SystemExit):
        main(["detect", "all", "--help"])
    common = capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["detect", "all", "--help-all"])
    everything = capsys.readouterr().out
    for flag in ("--radius-m", "--polarity", "--join-threshold", "--jobs", "--odometry", "--force"):
        assert flag in common
        assert flag in everything
    for flag in ("--separation", "--regulariser", "--cluster", "--wheel-base-m"):
        assert flag not in common
        assert flag in everything
    assert "More flags are shown by --help-all" in common
    assert "More flags are shown by --help-all" not in everything


def test_flags_for_experts_are_taken(tmp_path: Path) -> None:
    parsed = import_module(PROGRAMS["detect"]).parsed
    command = parsed(["all", str(tmp_path), "--separation", "0.5", "--line-ends", "crlf"])
    assert (command.circles.separation, command.line_ends) == (0.5, "crlf")


@pytest.mark.parametrize(
    ("former", "present"),
    [
        ("circles RUN --threshold 0.4", "circles RUN --quality-threshold 0.4"),
        ("lines RUN --threshold=0.4", "lines RUN --response-threshold=0.4"),
        ("lines RUN --tilt a.tilt", "lines RUN --tilt-output a.tilt"),
        ("explain IMAGE --threshold 0.4", "explain IMAGE --quality-threshold 0.4"),
        ("all RUN --circles.threshold=.4 --lines.threshold .2",
         "all RUN --quality-threshold=.4 --response-threshold .2"),
        ("all RUN --circles.radius-m .06 --lines.alpha=published",
         "all RUN --radius-m .06 --alpha=published"),
    ],
)  # fmt: skip
def test_former_spellings_of_flags_are_accepted(former: str, present: str) -> None:
    parsed = import_module(PROGRAMS["detect"]).parsed
    assert parsed(former.split()) == parsed(present.split()) != parsed(present.split()[:2])


@pytest.mark.parametrize("place", [0, 1, 9])
def test_quiet(place: int, tmp_path: Path, demo: Path, capsys: Captured) -> None:
    words = ["slam", "export", str(demo), "--to", "tum", "-o", str(tmp_path / "e.tum")]
    words.insert(place, "-q")
    assert main(words) == 0
    shown = capsys.readouterr()
    assert shown.out == ""
    assert (tmp_path / "e.tum").is_file()
    assert "REDETECT_QUIET" not in os.environ
    assert main(words) == 1
    assert capsys.readouterr().err.startswith("error: ")


@pytest.mark.parametrize("program", [[], ["detect"], ["slam"]])
def test_completion_is_written(program: list[str], tmp_path: Path, capsys: Captured) -> None:
    with pytest.raises(SystemExit) as end:
        main([*program, "--tyro-print-completion", "bash"])
    assert not end.value.code
    script = tmp_path / "completion.bash"
    script.write_text(capsys.readouterr().out)
    name = program[0] if program else "redetect"
    word, whole = {"redetect": ("expl", "explain"), "detect": ("circ", "circles"),
                   "slam": ("loc", "localize")}[name]  # fmt: skip
    ask = (
        f"source {script}; COMP_WORDS=({name} {word}); COMP_CWORD=1; "
        f'_tyro_{name}; echo "${{COMPREPLY[@]}}"'
    )
    done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [whole]


def test_explain(demo_image: Path, demo: Path, tmp_path: Path, capsys: Captured) -> None:
    outputs = ["-o", str(tmp_path / "why.png"), "--json", str(tmp_path / "why.json")]
    words = ["explain", str(demo_image), "--polarity", "light", "--at", "258", "111", *outputs]
    assert main(words) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "it is of the other polarity" in shown
    assert "camera level" not in shown  # discs have the right size
    assert "Try: --polarity any finds 1 there." in shown
    content = json.loads((tmp_path / "why.json").read_text())
    assert [row["stage"] for row in content["candidates"]] == ["polarity"]
    assert cv2.imread(str(tmp_path / "why.png")) is not None
    assert main(words) == 1
    assert "exists already" in capsys.readouterr().err
    assert main(["explain", str(demo)]) == 1
    assert "expected one image" in capsys.readouterr().err
    assert main(["explain", str(demo_image), "--no-refine"]) == 1
    assert "--no-refine" in capsys.readouterr().err
    (tmp_path / "far" / "away").mkdir(parents=True)
    lonely = tmp_path / "far" / "away" / "image.jpg"
    lonely.write_bytes(demo_image.read_bytes())
    assert main(["detect", "explain", str(lonely)]) == 1
    assert "no calibration" in capsys.readouterr().err
    for name in ("a.cam", "b.cam"):
        (lonely.parent / name).write_bytes((demo / "e.cam").read_bytes())
    assert main(["detect", "explain", str(lonely)]) == 1
    assert "several calibrations" in capsys.readouterr().err
    assert main(["detect", "explain", str(lonely), "--camera", str(lonely.parent / "a.cam")]) == 0


# -- the demo -------------------------------------------------------------------------------


def test_the_demo_of_the_package_is_the_demo_run(demo: Path) -> None:
    """`python -m tools.demo_package` copies it."""
    for name, own in (("e.txt", "demo.txt"), ("map.circles", ""), ("map.lines", ""),
                      ("unlisted.circles", ""), ("lookalikes.circles", "")):  # fmt: skip
        assert (DEMO_RUN / (own or name)).read_text() == first_frames((demo / name).read_text())
    assert (DEMO_RUN / "demo.cam").read_bytes() == (demo / "e.cam").read_bytes()
    images = sorted((DEMO_RUN / "images").iterdir())
    assert len(images) == FRAMES
    for image in images:
        assert image.read_bytes() == (demo / "images" / image.name).read_bytes()


@pytest.mark.long
def test_the_demo(tmp_path: Path, capsys: Captured) -> None:
    assert main(["demo", "-o", str(tmp_path / "demo")]) == 0
    *_, found, extra, errors, agreement = capsys.readouterr().out.splitlines()
    assert f"in {FRAMES} frames." in found
    assert "look like a disc" in extra
    assert "mm (median)" in errors
    assert "covariances" in agreement
    page = (tmp_path / "demo" / "demo.html").read_text()
    assert "The floor from above" in page
    assert main(["demo", "-o", str(tmp_path / "demo")]) == 1
    assert "exists already" in capsys.readouterr().err
