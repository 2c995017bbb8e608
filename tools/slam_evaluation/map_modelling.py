"""What takes chi-squared off a real run: mounting, tilt, rows believed less, other row covariances.

Where covariances differ chi-squared alone says nothing: so -2 log likelihood, chi-squared plus the
covariances' log determinants, is printed against that of the first line.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from redetect.slam.commands.run_camera import camera_of_run
from redetect.slam.mapping.graph_terms import Weighting, errors
from redetect.slam.mapping.run_map import MappedRun, map_run
from redetect.slam.recording import Recording, read_recording

#: What the published covariance of a row has whatever the row's place (m).
PUBLISHED_FLOOR_M = 0.04
_FAR_SIGMA = 4.0


@dataclass(frozen=True)
class Settings:
    """Try models on a run."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder or .circles file with the published covariances."""
    camera: Path | None = None
    """Its calibration."""


def variants(recording: Recording) -> Iterator[tuple[str, Recording, Weighting]]:
    """Models by name."""
    recorded = Weighting(calibrate=True, row_errors="recorded")
    yield "as shipped", recording, Weighting()
    yield "mounting (rows corrected)", recording, Weighting(calibrate=True)
    yield "mounting (rows as recorded)", recording, recorded
    for degrees in (0.25, 0.5, 1.0):
        tilted = replace(recorded, tilt_sigma_rad=float(np.radians(degrees)))
        yield f"  and tilt of {degrees:g} deg", recording, tilted
    tilted = replace(recorded, tilt_sigma_rad=float(np.radians(0.5)))
    for floor in (0.02, 0.03, 0.05, 0.06):
        yield f"  tilt 0.5 deg, floor {floor:g} m", with_floor(recording, floor), tilted
    for factor in (0.25, 0.5):
        weighed = replace(recording, step_covariance=recording.step_covariance * factor)
        yield f"  tilt 0.5 deg, odometry x{factor:g}", weighed, tilted


def with_floor(recording: Recording, floor_m: float) -> Recording:
    """A run whose rows' covariances have another constant part."""
    change = (floor_m**2 - PUBLISHED_FLOOR_M**2) * np.eye(2)
    circles = replace(recording.circles, covariance=recording.circles.covariance + change)
    return replace(recording, circles=circles)


def log_determinants(recording: Recording) -> float:
    """Sum of the covariances' log determinants."""
    known = recording.circles.ids >= 0
    total = np.sum(np.linalg.slogdet(recording.circles.covariance[known])[1])
    total += np.sum(np.linalg.slogdet(recording.step_covariance)[1])
    return float(total)


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    settings = tyro.cli(Settings, prog="map-modelling", args=arguments)
    recording = read_recording(settings.run)
    camera = camera_of_run(settings.run, settings.camera)
    print(
        f"{'model':<30}{'chi-sq.':>10}{'expected':>10}{'factor':>8}{'odometry':>10}{'rows':>9}"
        f"{'tilt':>8}{'rows > 4 s':>11}{'-2 log L':>10}"
    )
    first: float | None = None
    for name, run, weighting in variants(recording):
        mapped = map_run(run, camera, weighting)
        t = mapped.table
        fit = t.chi_squared + log_determinants(run)
        first = fit if first is None else first
        print(
            f"{name:<30}{t.chi_squared:>10.1f}{t.expected:>10}{t.factor:>8.2f}{t.odometry:>10.0f}"
            f"{t.discs:>9.0f}{t.tilt:>8.0f}{far_rows(mapped, weighting):>11}{fit - first:>10.0f}",
            flush=True,
        )
    return 0


def far_rows(mapped: MappedRun, weighting: Weighting) -> int:
    """Rows more than four standard deviations off."""
    off = errors(mapped.graph, mapped.estimate, weighting).discs
    return int(np.sum(np.sum(off**2, axis=1) > _FAR_SIGMA**2))
