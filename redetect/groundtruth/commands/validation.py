"""The commands ``groundtruth validate`` and ``report``: how good poses are."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtrc

from redetect import __version__
from redetect.array_types import FloatArray
from redetect.groundtruth.commands.outputs import check_outputs, provenance, remove_old, warn
from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.files import write_json
from redetect.groundtruth.fusion.clock import read_clock
from redetect.groundtruth.lasers.building import find_building, read_building
from redetect.groundtruth.lasers.scanners import find_scans, read_robot, read_scans
from redetect.groundtruth.options import Report, Validate
from redetect.groundtruth.report.inputs import gather
from redetect.groundtruth.report.page import report_page
from redetect.groundtruth.report.pictures import draw_errors, draw_scans
from redetect.groundtruth.trajectories.streams import read_planar_poses, write_planar_poses
from redetect.groundtruth.validation import onboard, reference_poses, scoring
from redetect.plane import pose_differences
from redetect.storage import write_bytes

#: Files written to the folder.
OUTPUTS = ("table.csv", "reference.csv", "errors.png", "scans.png", "validation.json")
_BY_CHANCE = 1e-6  #: A mount is wrong if its error is less probable than this.


def perform_validate(options: Validate) -> int:
    """Execute the command; returns the exit code: 1 without a reference pose to compare with."""
    session, folder = options.session, options.output
    if options.refine == "none" and options.clock is not None:
        raise GroundTruthError("--clock is for scans on board, which --refine none ignores")
    outputs = {name: folder / name for name in OUTPUTS}
    check_outputs(list(outputs.values()), options.force)
    survey = reference_poses.read_survey(session / "fiducials.json")
    measured = reference_poses.read_distances(session / "distances.csv", survey)
    if not measured:
        raise GroundTruthError(f"{session / 'distances.csv'}: no distances in it")
    poses = read_planar_poses(options.poses)
    files = [session / "fiducials.json", session / "distances.csv", options.poses]
    on_board: list[onboard.Onboard] = []
    clock, segments, clock_path = None, None, None
    if options.refine == "scans":
        map_file = find_building(session)
        segments = read_building(map_file)
        on_board, scan_files = _onboard(session)
        beside = session / "clock.json"
        clock_path = options.clock or (beside if beside.is_file() else None)
        if on_board and clock_path is None:
            warn("no clock.json: the times of the on-board scans are not corrected")
        clock = None if clock_path is None else read_clock(clock_path)
        files += [map_file, *scan_files, *([clock_path] if clock_path else [])]
    solved = reference_poses.poses_from_distances(survey, measured)
    near = None if segments is None else onboard.walls_in_view(segments, solved, on_board)
    if on_board and near is not None and not len(near):
        warn(f"no wall of {map_file} is near a reference pose: using distances only")
        on_board = []
    references, refused = onboard.reference_poses(solved, on_board, near, clock)
    for entry in refused:
        print(f"pose {entry.index}: {entry.status}: {entry.reason}", file=sys.stderr)
    if not references:
        raise GroundTruthError("not a single reference pose")
    errors, without = scoring.reference_errors(references, poses)
    for entry in without:
        print(f"pose {entry.index} at {entry.time_s:.3f} s: {entry.reason}", file=sys.stderr)
    if not errors.references:
        raise GroundTruthError("no ground truth at the time of any reference pose")
    score = scoring.score_poses(errors.poses, errors.reference_poses, len(without))
    rows = _table_rows(references, errors)
    figures: dict[str, Any] = asdict(score)
    if score.normalised:
        figures["normalised_band"] = scoring.normalised_band(score.normalised)
    content = {
        **provenance({"refine": options.refine}, files),
        "poses": options.poses.name,
        "clock": None if clock_path is None else clock_path.name,
        "figures": figures,
        "published": scoring.PUBLISHED,
        "refused": [*refused, *without],
        "distances": reference_poses.distance_figures(solved, survey.sigma_m),
        "rows": [
            {**row, "note": r.note, "points": r.points, "rms_m": r.rms_m}
            for row, r in zip(rows, references)
        ],
    }
    pictures = {"errors.png": draw_errors(errors, score)}
    if near is not None and any(r.averaged is not None for r in errors.references):
        content |= _scanners_on_board(references, near)
        pictures["scans.png"] = draw_scans(errors, near)
    folder.mkdir(parents=True, exist_ok=True)
    stream = scoring.stream_of(references)
    write_planar_poses(outputs["reference.csv"], stream, overwrite=options.force)
    write_json(outputs["validation.json"], content, overwrite=options.force)
    unwritten = [outputs["scans.png"]] if "scans.png" not in pictures else []
    remove_old(unwritten, options.force)
    for name, data in (("table.csv", _table_text(rows).encode()), *pictures.items()):
        write_bytes(outputs[name], data, overwrite=options.force)
    for line in summary_lines(references, refused, score, content["distances"]):
        print(line)
    print(f"{folder}: written")
    return 0


def _scanners_on_board(
    references: Sequence[onboard.ReferencePose], segments: FloatArray
) -> dict[str, Any]:
    """Errors of the ranges by their incidence on walls, and where the scanners are mounted."""
    angles, errors = onboard.range_errors(references, segments)
    rows: list[dict[str, Any]] = []
    for low, high in pairwise(onboard.INCIDENCES_DEG):
        inside = errors[(np.degrees(angles) >= low) & (np.degrees(angles) <= high)]
        mean = float(inside.mean()) if len(inside) else math.nan
        row = {"from_deg": low, "to_deg": high, "readings": len(inside), "mean_m": mean}
        rows.append({**row, "sigma_m": scoring.sigma_of(inside)})
    content: dict[str, Any] = {"incidence": rows}
    try:
        found = onboard.refine_mounts(references, segments)
    except GeometryError as error:
        warn(str(error))
        return content
    if found is not None:
        sigma = np.sqrt(np.diagonal(found.covariance)).reshape(-1, 3)
        content["mounts"] = [
            {"name": s.name, "given": s.pose.tolist(), "refined": m.tolist(), "sigma": e.tolist()}
            for s, m, e in zip(found.scanners, found.poses, sigma)
        ]
        for k, (scanner, mount) in enumerate(zip(found.scanners, found.poses)):
            own = slice(3 * k, 3 * k + 3)
            off = pose_differences(mount, scanner.pose)
            spread = scanner.covariance + found.covariance[own, own]
            if chdtrc(3, float(off @ np.linalg.solve(spread, off))) < _BY_CHANCE:
                warn(
                    f"scanner {scanner.name}: by the walls, it is mounted "
                    f"{1e3 * math.hypot(off[0], off[1]):.0f} mm and {math.degrees(off[2]):.2f} "
                    "degrees off what is stated"
                )
        on_board = next(r.averaged.scanners for r in references if r.averaged is not None)
        for scanner in on_board:
            if scanner not in found.scanners:
                warn(f"scanner {scanner.name}: no readings of walls: its mount is not refined")
    return content


def _table_rows(
    references: Sequence[onboard.ReferencePose], errors: scoring.ReferenceErrors
) -> list[dict[str, Any]]:
    """Rows of the table: every reference pose with its error, NaN if it has none."""
    columns = ("error_x_m", "error_y_m", "linear_m", "angular_deg", "nees")
    x, y, theta = errors.error.T
    nees = 3.0 * scoring.normalised_errors(errors.poses, errors.reference_poses)
    table = np.column_stack([x, y, np.hypot(x, y), np.degrees(theta), nees])
    by_index = {r.index: row for r, row in zip(errors.references, table.tolist())}
    rows: list[dict[str, Any]] = []
    for r in references:
        sigma = np.sqrt(np.diagonal(r.covariance))
        rows.append(
            {
                "pose": r.index,
                "t": r.time_s,
                **dict(zip(("x_m", "y_m", "theta_rad"), r.pose.tolist())),
                **dict(zip(("sigma_x_m", "sigma_y_m", "sigma_theta_rad"), sigma.tolist())),
                "distances": len(r.distances.residuals_m),
                "distance_rms_m": float(np.sqrt(np.mean(r.distances.residuals_m**2))),
                "scans": r.scans,
                **dict(zip(columns, by_index.get(r.index, [math.nan] * len(columns)))),
            }
        )
    return rows


def _table_text(rows: Sequence[dict[str, Any]]) -> str:
    """Rows as comma-separated lines with a head; missing values are empty."""
    decimals = {"nees": 4, "angular_deg": 5}

    def word(name: str, value: Any) -> str:
        if isinstance(value, float) and math.isnan(value):
            return ""
        return f"{value:.{decimals.get(name, 6)}f}" if isinstance(value, float) else str(value)

    lines = [",".join(rows[0])]
    lines += [",".join(word(name, value) for name, value in row.items()) for row in rows]
    return "\n".join(lines) + "\n"


def summary_lines(
    references: Sequence[onboard.ReferencePose],
    refused: Sequence[onboard.Refused],
    score: scoring.PoseScore,
    distances: dict[str, Any],
) -> list[str]:
    """The printed figures, with RAWSEEDS' beside them."""
    refined = sum(reference.scans == onboard.ScanUse.USED for reference in references)
    chi2 = distances["chi2_per_freedom"]
    return [
        f"reference poses    {len(references)} ({len(refused)} refused), {refined} refined by "
        "scans",
        f"distances          rms residual {1e3 * distances['rms_m']:.2f} mm, squared residuals per "
        f"degree of freedom {'-' if chi2 is None else f'{chi2:.2f}'}",
        *score.lines(),
        *(
            f"{p.name:<18} mean {1e3 * p.position_mean_m:.0f} mm, sigma "
            f"{1e3 * p.position_sigma_m:.0f}; mean {p.angle_mean_deg:+.2f} deg, sigma "
            f"{p.angle_sigma_deg:.2f} (published)"
            for p in scoring.PUBLISHED
        ),
    ]


def _onboard(session: Path) -> tuple[list[onboard.Onboard], list[Path]]:
    """The robot's scanners that have scans in the session, and the files read."""
    path = session / "robot.json"
    on_board, files = [], [path]
    for scanner in read_robot(path).scanners:
        try:
            found = find_scans(session, scanner.name)
        except GroundTruthError as error:
            warn(f"{error}: its scans are not used")
            continue
        # If a clock was set, times step back; the poses' own times are looked up.
        scans = read_scans(found, scanner.readings, ordered=False)
        on_board.append(onboard.Onboard(scanner, scans))
        files.append(found)
    if not on_board:
        warn("no scans of a scanner on board: using distances only")
    return on_board, files


def perform_report(options: Report) -> int:
    """Execute the command; returns the exit code."""
    output = options.output or options.session / "report.html"
    check_outputs([output], options.force)
    inputs = gather(options.session, options.truth)
    write_bytes(output, report_page(inputs, __version__), overwrite=options.force)
    for problem in inputs.problems:
        warn(problem)
    shown = [*inputs.streams, *(["truth"] if inputs.truth is not None else [])]
    print(f"{output}: {', '.join(shown) or 'no poses'}; {len(inputs.missing)} missing files")
    return 0
