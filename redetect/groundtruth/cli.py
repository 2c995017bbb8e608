"""The command ``groundtruth``.

Exit codes: 0 all went well; 1 the command could not be carried out, or gave no pose; 2 the command
line was wrong; 130 it was interrupted.
"""

from __future__ import annotations

from redetect.groundtruth.commands.options import COMMANDS
from redetect.storage.command_line import Program

PROGRAM = Program(
    "groundtruth",
    "Where the robot really was: markers, lasers, clocks, and their fusion.\n\n"
    "Example: groundtruth poses images/m -o poses.csv",
    {kind: f"redetect.groundtruth.commands.{kind.__name__.lower()}" for kind in COMMANDS},
)

main, parsed = PROGRAM.main, PROGRAM.parsed
