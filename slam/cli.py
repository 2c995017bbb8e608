"""The command ``slam``.

Exit codes: 0 all went well; 1 the command could not be carried out; 2 the command line was wrong;
130 it was interrupted, and wrote nothing.
"""

from __future__ import annotations

import sys

from slam.options import Associate, Ekf, Export, Import, Localize, Map, Noise
from storage.command_line import Program

PROGRAM = Program(
    "slam",
    "What landmarks are for: map, localisation, SLAM, association, noise.\n\n"
    "Example: slam map images/e --circles --lines -o /tmp/e-map",
    {
        Map: "slam.map_command",
        Localize: "slam.localize_command",
        Ekf: "slam.ekf_command",
        Associate: "slam.associate_command",
        Noise: "slam.noise_command",
        Export: "slam.export_command",
        Import: "slam.export_command",
    },
    compiled=(Map, Localize, Ekf, Associate),
)

main, parsed = PROGRAM.main, PROGRAM.parsed

if __name__ == "__main__":
    sys.exit(main())
