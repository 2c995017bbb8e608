"""The command ``detect``.

Only what `--help` needs is imported at once; each command imports its own heavy modules.

Exit codes: 0 success; 1 the command failed, or a condition of `compare` or `--strict` was not met;
2 wrong command line; 3 some frames could not be processed (the others were); 130 interrupted, with
only what `--resume` needs written.
"""

from __future__ import annotations

import atexit
import os
import re
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tyro import MISSING

from detect import options
from detect.errors import DetectError
from detect.line_settings import PRESETS as LINE_PRESETS
from detect.line_settings import LineSettings
from detect.settings import PRESETS as CIRCLE_PRESETS
from detect.settings import CircleSettings, MarkerSettings
from detect.settings_files import SettingsFile, read_settings
from detect.terminal import show_announcements
from redetect.command_line import Program, all_but
from redetect.interrupts import EXIT_INTERRUPTED
from redetect.messages import is_quiet

#: Flags that only `--help-all` shows.
EXPERT: dict[type, frozenset[str]] = {
    options.DetectorFlags: frozenset({"line_ends", "cluster", "strict"}),
    options.SourceOptions: all_but(options.SourceOptions, "odometry", "times", "frames"),
    options.DiscIdOptions: all_but(options.DiscIdOptions, "ids_from"),
    CircleSettings: all_but(
        CircleSettings, "radius_m", "polarity", "evidence",
        "calibration_px", "tilt_sigma_deg",
    ),
    LineSettings: all_but(LineSettings, "threshold", "join_rad"),
    MarkerSettings: all_but(MarkerSettings, "dictionary"),
    options.RowFiles: all_but(options.RowFiles, "rows", "reference"),
    options.CompareOptions: all_but(options.CompareOptions, "only_identified"),
}  # fmt: skip

_QUALITY, _RESPONSE = "--quality-threshold", "--response-threshold"
#: Former spellings of flags by command. In `detect all`, flags had the detector's name in front.
_RENAMED = {
    "circles": {"--threshold": _QUALITY},
    "explain": {"--threshold": _QUALITY},
    # In the other commands, --tilt is the tilt for which discs are corrected.
    "lines": {"--threshold": _RESPONSE, "--tilt": "--tilt-output"},
    "all": {"--circles.threshold": _QUALITY, "--lines.threshold": _RESPONSE},
}


class DetectProgram(Program):
    """The program: presets and settings files decide the defaults of flags."""

    def carry_out(self, command: Any) -> int:
        """Carry out a command; returns the exit code."""
        if not is_quiet():
            show_announcements()
        return super().carry_out(command)

    def parsed(self, arguments: Sequence[str], defaults: Sequence[object] = ()) -> Any:
        """Parse a command line; exits after `--help` and on errors."""
        arguments = [*_in_present_spelling(arguments)]
        radius = ArgumentParser(add_help=False, allow_abbrev=False)
        radius.add_argument("--radius-m", dest="given", nargs="?", action="append", default=[])
        found, rest = radius.parse_known_args(arguments)
        if found.given[-1:] == ["auto"] and arguments[0] in ("circles", "all"):
            arguments = [*rest, "--find-radius"]
        deciding = ArgumentParser(add_help=False, allow_abbrev=False)
        for flag in ("--preset", "--settings"):
            deciding.add_argument(flag, nargs="?", default="", const="")
        given = deciding.parse_known_args(arguments)[0]
        preset, file = given.preset, given.settings
        values = SettingsFile(
            CIRCLE_PRESETS.get(preset, CircleSettings()), LINE_PRESETS.get(preset, LineSettings())
        )
        if file and not {"-h", "--help", "--help-all"} & set(arguments):
            if preset:
                raise DetectError("--preset and --settings: expected one of them")
            values = read_settings(Path(file))
        known = (
            options.Circles(run=MISSING, detector=values.circles),
            options.Lines(run=MISSING, detector=values.lines),
            options.Markers(run=MISSING, detector=values.markers),
            options.All(run=MISSING, circles=values.circles, lines=values.lines),
            options.Explain(image=MISSING, detector=values.circles),
        )
        return super().parsed(arguments, (*known, *defaults))


def _in_present_spelling(arguments: Sequence[str]) -> Iterator[str]:
    """Replace former spellings of flags, which are still accepted."""
    renamed = _RENAMED.get(next(iter(arguments), ""), {})
    for word in arguments:
        flag, equals, value = word.partition("=")
        yield renamed.get(flag, re.sub(r"^--(circles|lines)\.", "--", flag)) + equals + value


PROGRAM = DetectProgram(
    "detect",
    "Landmarks with covariances from a calibrated camera's images.\n\nExample: detect all images/e",
    {
        **dict.fromkeys(
            (options.Circles, options.Lines, options.Markers, options.All),
            "detect.commands.run:perform",
        ),
        options.Compare: "detect.commands.compare:perform",
        options.Export: "detect.commands.export:perform",
        options.Draw: "detect.commands.draw:perform",
        options.View: "detect.commands.view:perform",
        options.Report: "detect.commands.report:perform_report",
        options.Tune: "detect.commands.tune:perform",
        options.Explain: "detect.commands.explain:perform",
        options.Demo: "detect.commands.report:perform_demo",
    },
    EXPERT,
)
parsed = PROGRAM.parsed


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    code = PROGRAM.main(arguments)
    if code == EXIT_INTERRUPTED and arguments is None:
        # Otherwise, Python dies of an interrupt that passed through some library's `exec`, even if
        # it was caught.
        atexit._run_exitfuncs()
        os._exit(code)
    return code
