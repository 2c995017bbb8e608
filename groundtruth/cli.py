"""The command ``groundtruth``.

Exit codes: 0 all went well; 1 the command could not be carried out, or gave no pose; 2 the command
line was wrong; 130 it was interrupted.
"""

from __future__ import annotations

from groundtruth.commands.options import (
    Fuse,
    Laser,
    Lasers,
    Network,
    Poses,
    Report,
    Rig,
    Score,
    Sync,
    Validate,
)
from storage.command_line import Program

PROGRAM = Program(
    "groundtruth",
    "Where the robot really was: markers, lasers, clocks, and their fusion.\n\n"
    "Example: groundtruth poses images/m -o poses.csv",
    {
        Rig: "groundtruth.commands.rig",
        Network: "groundtruth.commands.network",
        Poses: "groundtruth.commands.poses",
        Score: "groundtruth.commands.score",
        Lasers: "groundtruth.commands.lasers",
        Laser: "groundtruth.commands.laser",
        Sync: "groundtruth.commands.sync",
        Fuse: "groundtruth.commands.fuse",
        Validate: "groundtruth.commands.validate",
        Report: "groundtruth.commands.report",
    },
)

main, parsed = PROGRAM.main, PROGRAM.parsed
