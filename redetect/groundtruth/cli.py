"""The command ``groundtruth``.

Exit codes: 0 success; 1 the command failed, or gave no pose; 2 wrong command line; 130 interrupted.
"""

from __future__ import annotations

from redetect.command_line import Program
from redetect.groundtruth import options

_COMMANDS = "redetect.groundtruth.commands"

PROGRAM = Program(
    "groundtruth",
    "Where the robot really was: markers, lasers, clocks, and their fusion.\n\n"
    "Example: groundtruth poses images/m -o poses.csv",
    # In the order in which a session needs them.
    {
        options.Rig: f"{_COMMANDS}.markers:perform_rig",
        options.Network: f"{_COMMANDS}.markers:perform_network",
        options.Poses: f"{_COMMANDS}.markers:perform_poses",
        options.Score: f"{_COMMANDS}.validation:perform_score",
        options.Lasers: f"{_COMMANDS}.lasers:perform_lasers",
        options.Laser: f"{_COMMANDS}.lasers:perform_laser",
        options.Sync: f"{_COMMANDS}.fusion:perform_sync",
        options.Fuse: f"{_COMMANDS}.fusion:perform_fuse",
        options.Validate: f"{_COMMANDS}.validation:perform_validate",
        options.Report: f"{_COMMANDS}.validation:perform_report",
    },
)

main, parsed = PROGRAM.main, PROGRAM.parsed
