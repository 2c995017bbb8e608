"""The command ``groundtruth``.

Exit codes: 0 success; 1 the command failed, or gave no pose; 2 wrong command line; 130 interrupted.
"""

from __future__ import annotations

from redetect.command_line import Program
from redetect.groundtruth.options import COMMANDS

PROGRAM = Program(
    "groundtruth",
    "Where the robot really was: markers, lasers, clocks, and their fusion.\n\n"
    "Example: groundtruth poses images/m -o poses.csv",
    {kind: f"redetect.groundtruth.commands.{kind.__name__.lower()}" for kind in COMMANDS},
)

main, parsed = PROGRAM.main, PROGRAM.parsed
