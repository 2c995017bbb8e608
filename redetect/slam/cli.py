"""The command ``slam``.

Exit codes: 0 success; 1 the command failed; 2 wrong command line; 130 interrupted, without output.
"""

from __future__ import annotations

from redetect.command_line import Program
from redetect.slam.options import Associate, Audit, Ekf, Export, Import, Localize, Map, Noise

PROGRAM = Program(
    "slam",
    "Uses of landmarks: map, localisation, SLAM, association, noise.\n\n"
    "Example: slam map images/e --circles --lines -o /tmp/e-map",
    {
        Map: "redetect.slam.commands.map:perform",
        Audit: "redetect.slam.commands.audit:perform",
        Localize: "redetect.slam.commands.filters:perform",
        Ekf: "redetect.slam.commands.filters:perform",
        Associate: "redetect.slam.commands.associate:perform",
        Noise: "redetect.slam.commands.noise:perform",
        Export: "redetect.slam.commands.conversion:perform_export",
        Import: "redetect.slam.commands.conversion:perform_import",
    },
)

main, parsed = PROGRAM.main, PROGRAM.parsed
