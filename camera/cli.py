"""The command ``camera``.

Exit codes: 0 success; 1 the command failed; 2 wrong command line; 3 some frames of `camera level`
could not be processed (the others were); 130 interrupted, without output.
"""

from __future__ import annotations

from camera.options import Board, Calibrate, Convert, Floor, Level
from redetect.command_line import Program

PROGRAM = Program(
    "camera",
    "Print boards, calibrate a camera, estimate its pose, convert its calibration.\n\n"
    "Example: camera calibrate photographs --columns 9 --rows 6 --square-m 0.025 -o my.cam",
    {
        Board: "camera.commands.calibrate:perform_board",
        Calibrate: "camera.commands.calibrate:perform_calibrate",
        Floor: "camera.commands.floor:perform",
        # Needs detection, so the command is implemented in `detect`.
        Level: "detect.commands.level:perform",
        Convert: "camera.commands.convert:perform",
    },
)

main, parsed = PROGRAM.main, PROGRAM.parsed
