"""The chi-squared table of a least-squares solution, as the data set's report prints it."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.mapping.graph_terms import MOUNTING_UNKNOWNS, Weighting, errors


@dataclass(frozen=True)
class ChiSquared:
    """How large the errors are, and how large they should be."""

    poses: int  # p: the start and one per step
    landmarks: int  # n: discs and lines
    steps: int  # t: odometry measurements, the start's pose counted as one
    measurements: int  # m: landmark rows used
    # Parts of chi-squared.
    odometry: float
    discs: float
    lines: float
    tilt: float
    # Their sum: squared errors in units of the files' covariances, whatever loss was minimised.
    chi_squared: float
    expected: int  # dim(z) - dim(x): numbers measured less numbers estimated
    # chi_squared / expected: the variances' factor that would make both equal; NaN where nothing is
    # measured twice.
    factor: float
    root: float  # its root: the standard deviations' factor


def chi_squared(graph: Graph, estimate: Estimate, weighting: Weighting) -> ChiSquared:
    """Tabulate the squared errors of an estimate."""
    error = errors(graph, estimate, weighting)
    parts = [
        float(np.sum(part**2)) for part in (error.odometry, error.discs, error.lines, error.tilt)
    ]
    poses = len(graph.steps) + 1
    landmarks = len(graph.disc_ids) + len(graph.line_ids)
    # The start is measured (it is the origin) and estimated, so it adds as much as it takes.
    measured = 3 * poses + 2 * len(graph.disc_pose) + len(graph.line_pose) + error.tilt.size
    unknown = 3 * poses + 2 * landmarks + error.tilt.size
    if weighting.calibrate:
        unknown += MOUNTING_UNKNOWNS
    expected = measured - unknown
    factor = sum(parts) / expected if expected > 0 else math.nan
    return ChiSquared(
        poses=poses,
        landmarks=landmarks,
        steps=poses,
        measurements=len(graph.disc_pose) + len(graph.line_pose),
        odometry=parts[0],
        discs=parts[1],
        lines=parts[2],
        tilt=parts[3],
        chi_squared=sum(parts),
        expected=expected,
        factor=factor,
        root=math.sqrt(factor) if expected > 0 else math.nan,
    )


def table_lines(table: ChiSquared) -> list[str]:
    """The table as text, its rows in the report's order."""
    redundant = table.expected > 0
    rows = [
        ("poses p", f"{table.poses}"),
        ("landmarks n", f"{table.landmarks}"),
        ("odometry t (with the start)", f"{table.steps}"),
        ("landmark rows m", f"{table.measurements}"),
        ("chi-squared", f"{table.chi_squared:,.2f}"),
        ("expected dim(z) - dim(x)", f"{table.expected:,}"),
        ("factor", f"{table.factor:.2f}" if redundant else "-"),
        ("root of the factor", f"{table.root:.2f}" if redundant else "-"),
    ]
    return [f"{name:<28}{value:>12}" for name, value in rows]


def as_json(table: ChiSquared) -> dict[str, float | int | None]:
    """The table for a JSON file; NaN becomes null."""
    return {
        name: None if isinstance(value, float) and math.isnan(value) else value
        for name, value in asdict(table).items()
    }
