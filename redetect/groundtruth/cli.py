"""The command ``groundtruth``.

Exit codes: 0 success; 1 the command failed, or gave no pose; 2 wrong command line; 130 interrupted.
"""

from __future__ import annotations

from redetect.command_line import Program
from redetect.groundtruth import options

PROGRAM = Program(
    "groundtruth",
    "Where the robot really was: markers, lasers, clocks, and their fusion.\n\n"
    "Example: groundtruth poses images/m -o poses.csv",
    # In the order in which a session needs them.
    {
        options.Rig: "redetect.groundtruth.commands.markers:perform_rig",
        options.Network: "redetect.groundtruth.commands.markers:perform_network",
        options.Poses: "redetect.groundtruth.commands.poses:perform",
        options.Score: "redetect.groundtruth.commands.score:perform",
        options.Lasers: "redetect.groundtruth.commands.lasers:perform_lasers",
        options.Laser: "redetect.groundtruth.commands.lasers:perform_laser",
        options.Sync: "redetect.groundtruth.commands.fusion:perform_sync",
        options.Fuse: "redetect.groundtruth.commands.fusion:perform_fuse",
        options.Validate: "redetect.groundtruth.commands.validation:perform_validate",
        options.Report: "redetect.groundtruth.commands.validation:perform_report",
    },
)

main, parsed = PROGRAM.main, PROGRAM.parsed
