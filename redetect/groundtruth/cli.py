"""The command ``groundtruth``.

Exit codes: 0 all went well; 1 the command could not be carried out, or gave no pose; 2 the command
line was wrong; 130 it was interrupted.
"""

from __future__ import annotations

from redetect.groundtruth.commands.options import (
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
from redetect.storage.command_line import Program

PROGRAM = Program(
    "groundtruth",
    "Where the robot really was: markers, lasers, clocks, and their fusion.\n\n"
    "Example: groundtruth poses images/m -o poses.csv",
    {
        Rig: "redetect.groundtruth.commands.rig",
        Network: "redetect.groundtruth.commands.network",
        Poses: "redetect.groundtruth.commands.poses",
        Score: "redetect.groundtruth.commands.score",
        Lasers: "redetect.groundtruth.commands.lasers",
        Laser: "redetect.groundtruth.commands.laser",
        Sync: "redetect.groundtruth.commands.sync",
        Fuse: "redetect.groundtruth.commands.fuse",
        Validate: "redetect.groundtruth.commands.validate",
        Report: "redetect.groundtruth.commands.report",
    },
)

main, parsed = PROGRAM.main, PROGRAM.parsed
