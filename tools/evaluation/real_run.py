"""A recorded run with shipped rows: what the presets make of it, from the images to the map.

Everything goes through the command line, as a user would do it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from tools.evaluation.tables import markdown_table

#: How the rows of each line of the table are made; the camera's true spread of tilt and the lens
#: are stated for the honest ones (`docs/slam/real-run.md`).
_SPREAD = ("--tilt-sigma-deg", "0.6", "--calibration-px", "0.3")
WAYS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("shipped", "", ()),
    ("--preset published", "circles", ("--preset", "published")),
    ("default", "circles", ()),
    ("default, tilt and lens stated", "circles", _SPREAD),
    ("detect all", "all", ()),
    ("detect all, lens stated", "all", ("--circles.calibration-px", "0.3")),
)


def run_program(program: str, *arguments: object) -> None:
    """Run a program of the project quietly, in a process of its own."""
    words = [str(argument) for argument in arguments]
    subprocess.run([sys.executable, "-m", program, *words], check=True, stdout=subprocess.DEVNULL)


def measure_run(run: Path, folder: Path) -> Iterator[tuple[str, ...]]:
    """Detect a run in each of the ways, compare and map it; files go into `folder`.

    Each row: what made the rows, their number, the share of shipped identifiers found again, the
    median difference on the floor levelled alike, and chi-squared over its expectation of
    the least-squares map, as calibrated and with the camera's mounting as unknown.
    """
    shipped, camera = run / "map.circles", next(run.glob("*.cam"))
    for number, (way, command, flags) in enumerate(WAYS):
        output = folder / f"{number}"
        output.mkdir()
        rows = output / "detected.circles"
        if command:
            target = rows if command == "circles" else output
            run_program("detect", command, run, *flags, "--ids-from", shipped, "--output", target)
        else:
            rows.write_bytes(shipped.read_bytes())
        compared = output / "compared.json"
        run_program(
            "detect", "compare", run, "--detected", rows, "--only-identified", "--json", compared
        )
        result = json.loads(compared.read_text())
        factors = []
        for calibrate in ((), ("--calibrate",)):
            mapped = output / f"map{len(calibrate)}"
            run_program(
                "redetect", "slam", "map", rows, "--camera", camera, "-o", mapped, *calibrate
            )
            factors.append(json.loads((mapped / "table.json").read_text())["table"]["factor"])
        median_m = result["error_median_m"]
        yield (
            way, f"{result['detected'] + result['set_aside']:,}",
            f"{result['matched'] / result['reference']:.4f}",
            "-" if median_m is None else f"{1e3 * median_m:.1f}", *(f"{f:.2f}" for f in factors),
        )  # fmt: skip


@dataclass(frozen=True)
class RealRun:
    """Detect a recorded run by several presets, compare with its shipped rows, and map the rows."""

    run: Positional[Path] = Path("../shared/data/dlr/e")
    """Run folder with images, calibration and `map.circles`."""

    def __call__(self) -> int:
        head = ("rows", "number", "IDs found again", "difference / mm", "χ² factor",
                "with mounting")  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            print("\n".join(markdown_table(head, measure_run(self.run, Path(folder)))))
        return 0
