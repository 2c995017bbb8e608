"""A recorded run with shipped rows: what the presets make of it, from the images to the map.

Everything goes through the command line, as a user would do it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

#: How the rows of each line of the table are made; the camera's true spread of tilt and the lens
#: are stated for the honest ones (`docs/slam/real-run.md`).
_SPREAD = ("--tilt-sigma-deg", "0.6", "--calibration-px", "0.3")
WAYS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("--preset published", "circles", ("--preset", "published")),
    ("default", "circles", ()),
    ("default, tilt and lens stated", "circles", _SPREAD),
    ("detect all", "all", ()),
    ("detect all, lens stated", "all", ("--circles.calibration-px", "0.3")),
)


@dataclass(frozen=True)
class RunFigures:
    """One line of the table."""

    way: str  # What made the rows.
    rows: int  # Rows, shipped rows with an identifier found again, and all of those.
    matched: int
    shipped: int
    floor_median_m: float | None
    """Median difference on the floor from the shipped rows, after the common lean."""
    factor: float
    """Chi-squared over its expectation of the least-squares map, as calibrated and with the
    camera's mounting as unknown."""
    factor_calibrated: float


def measure_run(run: Path, folder: Path) -> list[RunFigures]:
    """Detect a run in each of the ways, compare and map it; files go into `folder`."""
    shipped = run / "map.circles"
    camera = next(run.glob("*.cam"))
    figures = []
    for number, (way, command, flags) in enumerate((("shipped", "", ()), *WAYS)):
        rows = shipped
        if command:
            output = folder / f"{number}"
            output.mkdir()
            rows = output / "detected.circles"
            target = rows if command == "circles" else output
            _run("detect", command, run, *flags, "--ids-from", shipped, "--output", target)
        compared = folder / f"{number}.json"
        _run("detect", "compare", run, "--detected", rows, "--only-identified", "--json", compared)
        result: dict[str, Any] = json.loads(compared.read_text())
        factors = []
        for calibrate in ((), ("--calibrate",)):
            mapped = folder / f"{number}{'-calibrated' * len(calibrate)}-map"
            _run("redetect.slam", "map", rows, "--camera", camera, "--output", mapped, *calibrate)
            factors.append(json.loads((mapped / "table.json").read_text())["table"]["factor"])
        left = (result["lean"] or {}).get("left", {})
        figures.append(
            RunFigures(
                way,
                result["detected"] + result["set_aside"],
                result["matched"],
                result["reference"],
                left.get("median_m", result["error_median_m"]),
                *factors,
            )
        )
    return figures


def table_of(figures: Sequence[RunFigures]) -> str:
    """The figures as a Markdown table."""
    lines = [
        "| rows | number | IDs found again | difference / mm | χ² factor | with mounting |",
        "|---|---|---|---|---|---|",
    ]
    for f in figures:
        apart = "-" if f.floor_median_m is None else f"{1e3 * f.floor_median_m:.1f}"
        lines.append(
            f"| {f.way} | {f.rows:,} | {f.matched / f.shipped:.4f} | {apart} | {f.factor:.2f} "
            f"| {f.factor_calibrated:.2f} |"
        )
    return "\n".join(lines)


def _run(program: str, *arguments: object) -> None:
    words = [str(argument) for argument in arguments]
    subprocess.run([sys.executable, "-m", program, *words], check=True, stdout=subprocess.DEVNULL)


@dataclass(frozen=True)
class RealRun:
    """Detect a recorded run by several presets, compare with its shipped rows, and map the rows."""

    run: Positional[Path] = Path("../shared/data/dlr/e")
    """Run folder with images, calibration and `map.circles`."""

    def __call__(self) -> int:
        with tempfile.TemporaryDirectory() as folder:
            print(table_of(measure_run(self.run, Path(folder))))
        return 0
