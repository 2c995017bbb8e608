"""Every command line that a document shows is one that its command accepts."""

from __future__ import annotations

import argparse
import re
import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from runpy import run_module
from typing import Any

import pytest
import tyro

from redetect import command_line
from redetect.cli import PROGRAMS
from tests.docs.blocks import blocks_of, commands_in, documents


class Parsed(BaseException):
    """The command line is accepted, and nothing is to be done about it here."""


@pytest.fixture
def accepts(monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], bool]:
    """Whether a command accepts the words behind its name; it does not come to performing."""

    def parse_only(parse: Callable[..., Any]) -> Callable[..., Any]:
        def parse_and_stop(*arguments: Any, **options: Any) -> Any:
            parsed = parse(*arguments, **options)
            if "return_unknown_args" in options:
                return parsed  # what is unknown is refused later
            raise Parsed

        return parse_and_stop

    for place, name in (
        (tyro, "cli"),
        (command_line, "_parsed_as"),
        (tyro.extras, "subcommand_cli_from_dict"),
        (argparse.ArgumentParser, "parse_args"),
    ):
        monkeypatch.setattr(place, name, parse_only(getattr(place, name)))

    def accepts(words: list[str]) -> bool:
        monkeypatch.setattr(sys, "argv", words)
        try:
            start(words)
        except Parsed:
            return True
        except SystemExit:
            pass  # refused, or `--help`
        return False

    return accepts


def start(words: list[str]) -> None:
    """Start a program of the project, `slam`, or a script, `tools.soak`."""
    if words[0].startswith("tools."):
        with warnings.catch_warnings():
            # That the module has been imported already does not matter here.
            warnings.simplefilter("ignore", RuntimeWarning)
            run_module(words[0], run_name="__main__", alter_sys=True)
    else:
        import_module({**PROGRAMS, "redetect": "redetect.cli"}[words[0]]).main(words[1:])


def test_every_command_line_is_accepted(
    project_root: Path, accepts: Callable[[list[str]], bool], capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:  # fmt: skip
    # A file of settings decides what flags begin with: it has to be there.
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "tuned.json").write_text('{"settings": {}}')
    monkeypatch.chdir(tmp_path)
    shown: dict[tuple[str, ...], str] = {}
    for document in documents(project_root):
        for block in blocks_of(document):
            if block.language in ("", "console", "bash", "sh"):
                for line, words in commands_in(block):
                    place = f"{document.relative_to(project_root)}:{line}"
                    shown.setdefault(tuple(words), place)
    assert len(shown) > 100
    refused = []
    for command, place in shown.items():
        if not accepts(list(command)):
            refused.append(f"{place}: {' '.join(command)}\n{capsys.readouterr()[1]}")
    assert not refused, "\n".join(refused)


def test_commands_within_sentences_exist(project_root: Path) -> None:
    commands = {name: import_module(module).PROGRAM.commands for name, module in PROGRAMS.items()}
    named = re.compile(rf"`(?:redetect )?({'|'.join(PROGRAMS)}) ([a-z][a-z-]*)[ `]")
    shown = [
        (document.name, *words)
        for document in documents(project_root)
        for words in named.findall(document.read_text("utf-8"))
    ]
    assert len(shown) > 200
    assert [one for one in shown if one[2] not in commands[one[1]]] == []


def test_a_wrong_command_line_is_noticed(accepts: Callable[[list[str]], bool]) -> None:
    assert accepts(["detect", "circles", "images/e"])
    assert not accepts(["detect", "circles", "images/e", "--no-such-flag"])
    assert not accepts(["tools.simulator", "no-such-command"])


def test_command_lines_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "Text.\n\n    detect circles RUN \\\n        --force   # again\n\n"
        "```console\n$ for c in a b; do detect markers $c; done && slam map RUN\nprinted\n```\n"
        "    detect all continued paragraph, no block\n"
    )
    found = [line_and_words for block in blocks_of(page) for line_and_words in commands_in(block)]
    assert found == [
        (3, ["detect", "circles", "RUN", "--force"]),
        (7, ["detect", "markers", "a"]),
        (7, ["slam", "map", "RUN"]),
    ]
