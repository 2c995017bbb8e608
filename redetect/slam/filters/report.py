"""Figures of a filter's run: how far from a reference, and whether innovations are as expected."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from redetect import slam
from redetect.landmarks import squared_mahalanobis, wrap_angle
from redetect.landmarks.map_file import LandmarkMap, Path2D
from redetect.slam.errors import SlamError
from redetect.slam.filters.frames import FilterRun


def path_distance(path: Path2D, reference: ArrayLike) -> dict[str, float]:
    """How far a path is from another one of the same run in the same map, `reference` (N, 3).

    Root mean square, median and largest distance of positions (m) and headings (rad), and those of
    the last pose.
    """
    other = np.asarray(reference, dtype=np.float64)
    position = np.hypot(*(path.poses[:, :2] - other[:, :2]).T)
    heading = np.abs(wrap_angle(path.poses[:, 2] - other[:, 2]))
    return {
        f"{name}_{figure}_{unit}": float(value)
        for name, unit, distance in (("position", "m", position), ("heading", "rad", heading))
        for figure, value in (
            ("rms", math.sqrt(float(np.mean(distance**2)))),
            ("median", np.median(distance)),
            ("max", np.max(distance)),
            ("last", distance[-1]),
        )
    }


def map_distance(landmark_map: LandmarkMap, reference: LandmarkMap) -> dict[str, float]:
    """How far landmarks are from those of another map with the same identifiers."""
    offsets, covariances = [], []
    for some, others in (
        (landmark_map.discs, reference.discs),
        (landmark_map.lines, reference.lines),
    ):
        _, own, other = np.intersect1d(some.ids, others.ids, return_indices=True)
        offsets.append(some.xy[own] - others.xy[other])
        covariances.append(some.covariance[own])
    offset, covariance = np.concatenate(offsets), np.concatenate(covariances)
    if not len(offset):
        raise SlamError("no landmark is in both maps: expected some of the same identifiers")
    distance = np.hypot(*offset.T)
    return {
        "landmarks": float(len(distance)),
        "rms_m": math.sqrt(float(np.mean(distance**2))),
        "median_m": float(np.median(distance)),
        "max_m": float(np.max(distance)),
        "normalised": float(np.mean(squared_mahalanobis(offset, covariance))) / 2.0,
    }


def summary(
    run: FilterRun, settings: dict[str, Any], distance: dict[str, float] | None
) -> dict[str, Any]:
    """Content of the command's .json file."""
    count = run.count
    figures: dict[str, object] = {
        "steps": len(run.path.poses) - 1,
        "disc_rows_used": count.discs,
        "line_rows_used": count.lines,
        "rows_left_out": dict(sorted(count.left_out.items())),
        "innovation_squared": count.innovation_squared,
        "innovation_expected": count.innovation_numbers,
    }
    if distance is not None:
        figures["distance_from_reference"] = distance
    return {"version": slam.__version__, "settings": settings, "figures": figures}


def table(run: FilterRun, distance: dict[str, float] | None) -> list[str]:
    """Lines for the terminal."""
    count = run.count
    lines = [f"steps             {len(run.path.poses) - 1}"]
    used = [f"{count.discs} of discs"] * bool(count.discs) + [f"{count.lines} of lines"] * bool(
        count.lines
    )
    lines.append(f"rows used         {', '.join(used) or 'none'}")
    for reason, number in sorted(count.left_out.items()):
        lines.append(f"left out          {number} ({reason})")
    if count.innovation_numbers:
        factor = count.innovation_squared / count.innovation_numbers
        lines.append(
            f"innovations       chi2 {count.innovation_squared:.1f}, expected "
            f"{count.innovation_numbers}, factor {factor:.2f}, its root {math.sqrt(factor):.2f}"
        )
    if distance is not None:
        lines.append(
            "from reference    position rms {position_rms_m:.3f} m, median "
            "{position_median_m:.3f}, max {position_max_m:.3f}, last {position_last_m:.3f}".format(
                **distance
            )
        )
        degrees = {k: math.degrees(v) for k, v in distance.items() if k.startswith("heading")}
        lines.append(
            "                  heading rms {heading_rms_rad:.2f} deg, median "
            "{heading_median_rad:.2f}, max {heading_max_rad:.2f}, last {heading_last_rad:.2f}"
            "".format(**degrees)
        )
    return lines
