"""Every command's help shows an example, and every example is a command line that parses."""

from __future__ import annotations

import io
import json
import re
import shlex
import subprocess
import sys
from contextlib import redirect_stdout
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import pytest

from redetect.cli import PROGRAMS, main


@cache
def help_of(program: str, *words: str) -> str:
    shown = io.StringIO()
    with redirect_stdout(shown), pytest.raises(SystemExit) as end:
        import_module(PROGRAMS[program]).main([*words, "--help"])
    assert end.value.code == 0
    return shown.getvalue()


def commands_of(program: str) -> list[str]:
    choices = re.search(r"\{(\w+(?:,\s*\w+)*)\}", help_of(program))
    assert choices is not None
    return re.split(r",\s*", choices[1])


def examples_in(text: str) -> list[list[str]]:
    """The command lines of a help text: what stands behind a colon and begins with a program."""
    found = []
    before_the_flags = re.split(r"^\W+(?:options|positional arguments)\b", text, flags=re.M)[0]
    for paragraph in before_the_flags.split("\n\n"):
        if paragraph.startswith("usage:"):
            continue
        for piece in " ".join(paragraph.split()).split(": "):
            words = re.sub(r",? (or|then)$", "", piece)
            if words.split(" ")[0] in PROGRAMS:
                found.append(shlex.split(words))
    return found


@pytest.mark.lowest
@pytest.mark.parametrize("program", PROGRAMS)
def test_every_help_shows_an_example_that_parses(program: str) -> None:
    commands = commands_of(program)
    assert len(commands) >= 3
    for command in commands:
        examples = examples_in(help_of(program, command))
        assert [program, command] in [words[:2] for words in examples], command
        for words in examples:
            # It may be another program's.
            parsed = import_module(PROGRAMS[words[0]]).parsed
            assert type(parsed(words[1:])).__name__.lower() == words[1]


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_programs_own_help_shows_an_example_that_parses(program: str) -> None:
    (words,) = examples_in(help_of(program))
    assert type(import_module(PROGRAMS[program]).parsed(words[1:])).__name__.lower() == words[1]


def test_an_example_with_a_flag_that_is_none_is_noticed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    (words,) = examples_in("Example: slam map images/e --no-such-flag")
    with pytest.raises(SystemExit) as end:
        import_module("redetect.slam.cli").parsed(words[1:])
    assert end.value.code == 2
    assert "no-such-flag" in capsys.readouterr().err


@pytest.mark.lowest
@pytest.mark.parametrize("program", PROGRAMS)
def test_every_program_says_its_version(program: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        import_module(PROGRAMS[program]).main(["--version"])
    assert end.value.code == 0
    assert re.fullmatch(rf"{program} \d+\.\d+\.\d+\S*\n", capsys.readouterr().out)


@pytest.mark.parametrize("program", sorted(PROGRAMS))
def test_every_flag_has_help(program: str) -> None:
    for command in commands_of(program):
        text = help_of(program, command)
        assert "options options" not in text, command
        lines = [line.strip("│╭╰ \n") for line in text.split("\n")]
        for line, following in pairwise(lines):
            flag = re.match(r"(?:-\w, )?(--[a-z][\w.-]+)", line)
            words = re.split(r"\s{2,}", line, maxsplit=1)[1:] or [following]
            if flag and len(line) < 100:
                assert not re.match(r"\((default|required)", words[0]), f"{command} {flag[1]}"


def test_json_alone_on_standard_output(
    project_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = project_root / "images" / "e"
    shipped = str(run / "map.circles")
    assert main(["detect", "compare", str(run), "--detected", shipped, "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["missed"] == 0
    assert not Path("-").exists()


@pytest.mark.lowest
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("detect all images/e --radius-n 1", "no flag '--radius-n': did you mean --radius-m?"),
        ("detect circles images/e --radius-m x", "--radius-m x: expected above 0"),
        ("detect circles images/e --jobs=x", "--jobs x: expected a whole number or none"),
        ("detect circles images/e --threshold 7", "--quality-threshold is 7: expected above 0"),
        ("detect explain e.jpg --at 1", "--at 1: expected 2 numbers"),
        ("slam map images/e --loss x", "--loss x: expected one of none, huber"),
        ("slam map images/e --camera", "slam map: --camera: expected a path"),
        ("slam export images/e -o x y z", "slam export: '"),
        ("camera calibrate a --rows 6", "camera calibrate: expected --output --columns --square-m"),
        ("groundtruth laser", "groundtruth laser: expected SESSION"),
        ("detect draw", "detect draw: expected RUN"),
        ("slam", "slam: no command '': one of associate, audit"),
        ("slam --loss huber", "slam: no command '--loss': one of"),
    ],
)
def test_a_wrong_word_is_named_on_one_line(
    words: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(words.split())
    assert end.value.code == 2
    out, err = capsys.readouterr()
    assert said in err
    assert not out
    assert err.count("\n") == 1


def test_a_closed_standard_output_costs_nothing(tmp_path: Path, project_root: Path) -> None:
    command = f"{sys.executable} -m redetect camera convert images/e/e.cam {tmp_path}/e.opencv.yaml"
    done = subprocess.run(
        f"{command} >&-", shell=True, cwd=project_root, stderr=subprocess.PIPE, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
