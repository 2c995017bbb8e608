"""A recorded run with shipped rows: results of the presets, from the images to the map.

Everything goes through the command line, as a user would do it.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from tools.evaluation.figures import Figures, Study, compared, demand_some, run_program
from tools.evaluation.tables import Table

#: How the rows of each line of the table are made.
WAYS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("shipped", "", ()),
    ("--preset published", "circles", ("--preset", "published")),
    ("default", "circles", ()),
    ("detect all", "all", ()),
    ("detect all, lens stated", "all", ("--calibration-px", "0.3")),
)


@dataclass(frozen=True)
class RealRun(Study):
    """Detect a recorded run with several presets, compare with shipped rows, and map the result."""

    run: Positional[Path] = Path("../shared/data/dlr/e")
    """Run folder with images, calibration and `map.circles`."""

    def measure(self) -> Figures:
        """Rows; the share of shipped identifiers found again; the median difference on the floor,
        levelled alike; chi-squared over its expectation of the least-squares map, as calibrated and
        with the camera's mounting as unknown.
        """
        shipped, cameras = self.run / "map.circles", list(self.run.glob("*.cam"))
        demand_some(cameras, f"{self.run}/*.cam")
        table = Table(
            {"rows": "<30", "number": ",", "IDs found again": ".4f", "mm": "5.1f",
             "factor": ".2f", "with mounting": ".2f"}
        )  # fmt: skip
        for way, command, flags in WAYS:
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                rows = folder / "detected.circles"
                if command:
                    output = rows if command == "circles" else folder
                    run_program("detect", command, self.run, *flags, "--ids-from", shipped,
                                "--output", output)  # fmt: skip
                else:
                    rows.write_bytes(shipped.read_bytes())
                found, factors = compared(self.run, rows, "--only-identified"), []
                for flag in ((), ("--calibrate",)):
                    mapped = folder / f"map{len(flag)}"
                    run_program("slam", "map", rows, "--camera", cameras[0], "-o", mapped, *flag)
                    written = json.loads((mapped / "table.json").read_text())
                    factors.append(written["table"]["factor"])
            table.row(
                way, found["detected"] + found["set_aside"], found["matched"] / found["reference"],
                1e3 * found["error_median_m"], *factors,
            )  # fmt: skip
        return table.figures
