"""The command ``redetect``: all programs of the project behind one name.

Exit codes are those of the program; 2 if there is no such command.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import make_dataclass
from functools import reduce
from importlib import import_module
from operator import or_
from typing import Annotated, Any

from redetect import __version__
from redetect.command_line import EXIT_WRONG_COMMAND_LINE, FOR_ALL, end_with, exit_code_of
from redetect.messages import no_such

PROGRAMS = {
    "camera": "camera.cli",
    "detect": "detect.cli",
    "groundtruth": "redetect.groundtruth.cli",
    "slam": "redetect.slam.cli",
}
#: Commands of `detect` that are also commands of `redetect`.
DIRECT = ("compare", "draw", "view", "report", "tune", "export", "explain", "demo")

_QUIET = ("-q", "--quiet")

_HEAD = (
    "Landmarks with covariances from a calibrated camera's images, and their uses.\n\n"
    "Example: redetect detect all images/e"
)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    # Anywhere else it is a flag of the command.
    leading = [word for word in given[:1] if word in _QUIET]
    words = [*given[len(leading) :], *leading]
    if words[:1] == ["--version"]:
        return exit_code_of(lambda: _shown(f"redetect {__version__}\n"))
    if not words:
        print(_help(), end="", file=sys.stderr)
        return EXIT_WRONG_COMMAND_LINE
    if words[0] in ("-h", "--help", "--help-all"):
        return exit_code_of(lambda: _shown(_help()))
    if words[0].startswith("--tyro-"):
        _write_completion(words)
    name, rest = words[0], words[1:]
    if name in DIRECT:
        name, rest = "detect", words
    if name not in PROGRAMS:
        for other, module in PROGRAMS.items():
            if name in import_module(module).PROGRAM.commands:
                end_with(f"redetect: no command {name!r}: did you mean redetect {other} {name}?")
        end_with(no_such("redetect: no command", name, (*PROGRAMS, *DIRECT)))
    program = import_module(PROGRAMS[name])
    if arguments is not None:
        return int(program.main(rest))
    # As if it were called by its short name, including the way it ends the process.
    sys.argv = [name, *rest]
    return int(program.main())


def _shown(text: str) -> int:
    print(text, end="")
    return 0


def _help() -> str:
    lines = ["usage: redetect COMMAND ...", "", _HEAD, ""]
    direct = import_module(PROGRAMS["detect"]).PROGRAM.commands
    for name, module in sorted(PROGRAMS.items()):
        program = import_module(module).PROGRAM
        lines.append(f"  {name:12} {program.description.splitlines()[0]}")
        lines.append(f"  {'':12} {name} {{{','.join(program.commands)}}}")
    lines.append("")
    for name in DIRECT:
        lines.append(f"  {name:12} {(direct[name].__doc__ or '').splitlines()[0]}")
    return "\n".join([*lines, "", FOR_ALL, ""])


def _write_completion(words: list[str]) -> None:
    """Let tyro write the completion of all programs' commands; ends the process."""
    import tyro
    from tyro.conf import arg, subcommand

    def choice(commands: Mapping[str, type]) -> Any:
        kinds: Any = (Annotated[kind, subcommand(name)] for name, kind in commands.items())
        return Annotated[reduce(or_, kinds), arg(name="")]

    programs = {name: import_module(module).PROGRAM for name, module in PROGRAMS.items()}
    below = {
        name: make_dataclass(name, [("command", choice(program.commands))])
        for name, program in programs.items()
    }
    direct = {name: programs["detect"].commands[name] for name in DIRECT}
    tyro.cli(choice({**below, **direct}), prog="redetect", args=words)


if __name__ == "__main__":
    sys.exit(main())
