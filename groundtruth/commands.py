"""What the commands of ``groundtruth`` do: files, progress and messages round the estimations."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from groundtruth.cli import EXIT_ERROR, Network, Poses, Rig, Score
from groundtruth.errors import GroundTruthError

if TYPE_CHECKING:
    from groundtruth import calibration
    from groundtruth.network_estimation import BoardView, NetworkEstimate
    from groundtruth.rig_estimation import RigEstimate
    from groundtruth.session import MarkerFrame


def perform(command: Rig | Network | Poses | Score) -> int:
    """Carry out a command; returns the exit code."""
    if isinstance(command, Rig):
        from groundtruth.rig_command import make_rig

        return make_rig(command)
    if isinstance(command, Network):
        return _network(command)
    if isinstance(command, Poses):
        return _poses(command)
    return _score(command)


def check_outputs(paths: Sequence[Path | None], force: bool) -> None:
    """Refuse to begin where an output exists, unless it may be replaced."""
    from storage import OutputExistsError

    for path in paths:
        if path is not None and path.exists() and not force:
            raise OutputExistsError(path)


def provenance(settings: Any, files: Sequence[Path] = ()) -> dict[str, Any]:
    """What stands beside a result: version, settings, and the files that it depends on."""
    from groundtruth import __version__

    return {
        "version": __version__,
        "settings": asdict(settings),
        "files": {
            path.name: {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()} for path in files
        },
    }


@contextmanager
def progress(label: str) -> Iterator[tuple[Callable[[int], None], Callable[[], None]]]:
    """A progress bar on a terminal; yields what to tell the total to, and what to call on."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )
    with bar:
        task = bar.add_task(label, total=None)
        yield lambda total: bar.update(task, total=total), lambda: bar.advance(task)


def _poses(command: Poses) -> int:
    from groundtruth.calibration import read_network, read_rig
    from groundtruth.session import RIG_NAME, find_runs
    from groundtruth.streams import format_tum, write_planar_poses
    from groundtruth.track import report_entry, track_robot
    from storage import write_whole

    runs, network_path = find_runs(command.paths, command.network)
    folder = network_path.parent if command.network is None else command.paths[0]
    rig_path = command.rig if command.rig is not None else folder / RIG_NAME
    output = command.output if command.output is not None else folder / "poses.csv"
    settings_path = output.with_suffix(".json")
    check_outputs((output, settings_path, command.tum, command.report), command.force)
    network = read_network(network_path)
    rig = read_rig(rig_path)
    frames = read_all_frames(runs, network)
    with progress("poses") as (count, advance):
        track = track_robot(
            frames, rig, network, command.settings, on_progress=advance, on_count=count
        )
    poses = track.planar()
    print(
        f"{len(poses)} poses of {len(track.times)} times: "
        + ", ".join(f"{number} {status}" for status, number in track.counts.items() if number)
    )
    if track.unknown_markers:
        print(f"{track.unknown_markers} markers found are not on the rig: left out")
    left_out = sum(int((~pose.views).sum()) for _, pose in track.posed)
    if left_out:
        print(f"{left_out} markers do not fit the others of their time: left out")
    if command.report is not None:
        with write_whole(command.report, overwrite=command.force) as stream:
            for tracked in track.times:
                line = json.dumps(report_entry(tracked, network), allow_nan=False)
                stream.write(f"{line}\n".encode())
    if not len(poses):
        print("error: no pose", file=sys.stderr)
        return EXIT_ERROR
    print(f"squared residuals per degree of freedom: {track.reduced_cost:.2f}")
    write_planar_poses(output, poses, overwrite=command.force)
    _write_json(
        settings_path,
        {
            **provenance(command.settings, (rig_path, network_path)),
            "columns": "t x y theta, covariance of x y theta row by row (s, m, rad)",
            "times": dict(track.counts),
            "reduced_cost": track.reduced_cost,
        },
        command.force,
    )
    if command.tum is not None:
        import numpy as np

        text = format_tum(
            poses.times_s, np.stack([pose.world_from_robot for _, pose in track.posed])
        )
        with write_whole(command.tum, overwrite=command.force) as stream:
            stream.write(text.encode())
    print(f"{output}: written")
    return 0


def read_all_frames(runs: Sequence[Path], network: calibration.Network) -> list[MarkerFrame]:
    """The markers found in all runs, whose folders' names are the cameras'.

    Raises
    ------
    GroundTruthError
        If a folder's name is no camera of the network.
    """
    from groundtruth.session import read_marker_frames

    frames = []
    for run in runs:
        name = run.resolve().name
        if name not in network.names:
            raise GroundTruthError(
                f"{run}: is no camera of the network: expected one of {', '.join(network.names)}"
            )
        frames += read_marker_frames(run, network.names.index(name))
    return frames


def _score(command: Score) -> int:
    from groundtruth.relative_errors import read_relations, score_relations, score_steps
    from groundtruth.scoring import matched_streams, moved_poses, planar_alignment, score_poses
    from groundtruth.streams import read_planar_poses

    check_outputs((command.json,), command.force)
    solution, truth = read_planar_poses(command.poses), read_planar_poses(command.truth)
    relations = None if command.relations is None else read_relations(command.relations)
    poses, truth, unmatched = matched_streams(
        solution, truth, largest_gap_s=command.largest_gap_s, interpolate=command.interpolate
    )
    alignment = planar_alignment(poses, truth) if command.align else None
    if alignment is not None:
        poses = moved_poses(poses, alignment)
    score = score_poses(poses, truth, unmatched)
    print(f"poses             {score.poses} ({score.unmatched} without the other at their time)")
    print(
        f"position error    mean {1e3 * score.position_mean_m:.2f} mm, sigma "
        f"{1e3 * score.position_sigma_m:.2f}, rmse {1e3 * score.position_rmse_m:.2f}, "
        f"max {1e3 * score.position_max_m:.2f}"
    )
    print(
        f"angle error       mean {math.degrees(score.angle_mean_rad):.3f} deg, sigma "
        f"{math.degrees(score.angle_sigma_rad):.3f}, max {math.degrees(score.angle_max_rad):.3f}"
    )
    if score.normalised:
        print(
            f"normalised error squared / dof  {score.normalised_error:.3f} "
            f"({score.normalised} poses with a covariance that can be inverted)"
        )
    else:
        print("normalised error squared / dof  none: no covariance that can be inverted")
    relative = {}
    if relations is not None:
        relative["relations"] = score_relations(solution, relations, command.largest_gap_s)
    if command.rpe_step is not None:
        steps = score_steps(poses, truth, command.rpe_step, command.rpe_longest_s)
        relative[f"steps of {command.rpe_step}"] = steps
    for name, figures in relative.items():
        print(
            f"relative error, {name}: {figures.pairs} pairs ({figures.unmatched} left out), "
            f"rmse {1e3 * figures.position_rmse_m:.2f} mm, median "
            f"{1e3 * figures.position_median_m:.2f}, max {1e3 * figures.position_max_m:.2f}; "
            f"rmse {math.degrees(figures.angle_rmse_rad):.3f} deg"
        )
    if command.json is not None:
        values: dict[str, Any] = {k: v if v == v else None for k, v in asdict(score).items()}
        if alignment is not None:
            values["alignment"] = alignment.tolist()
        if relative:
            values["relative"] = {name: asdict(figures) for name, figures in relative.items()}
        _write_json(command.json, values, command.force)
    return 0


def _network(command: Network) -> int:
    import os

    from groundtruth import calibration
    from groundtruth.boards_file import find_boards, read_boards
    from groundtruth.network_estimation import estimate_network

    check_outputs((command.output,), command.force)
    boards = read_boards(command.boards)
    shots: dict[int, list[BoardView]] = {}
    failures = []
    with progress("boards") as (count, advance):
        count(len(boards.images))
        for image in boards.images:
            try:
                view = find_boards(image, boards.boards[image.board], boards.cameras[image.camera])
                shots.setdefault(image.placement, []).append(view)
            except GroundTruthError as error:
                failures.append(str(error))
            advance()
    for line in failures:
        print(f"left out: {line}", file=sys.stderr)
    double = boards.double
    if double is not None and command.estimate_offset:
        double = replace(double, offset=None)
    estimate = estimate_network(
        boards.cameras,
        boards.boards,
        {"world": boards.world_from_board},
        double,
        list(shots.values()),
        command.settings,
    )
    folder = command.boards if command.boards.is_dir() else command.boards.parent
    calibrations = tuple(
        Path(os.path.relpath(folder / boards.calibrations[name], command.output.parent)).as_posix()
        for name in estimate.names
    )
    network = calibration.Network(
        estimate.names,
        tuple(boards.cameras[name] for name in estimate.names),
        calibrations,
        estimate.world_from_camera,
        estimate.covariance,
    )
    table = _board_residuals(estimate)
    calibration.write_network(
        command.output,
        network,
        {
            "made_by": provenance(command.settings),
            "reduced_cost": estimate.adjusted.reduced_cost,
            "residuals": table,
        },
        overwrite=command.force,
    )
    print_table(table)
    _print_sigmas("camera", list(estimate.names), estimate.covariance)
    print(f"{command.output}: {len(estimate.names)} cameras")
    return 0


def _board_residuals(estimate: NetworkEstimate) -> list[dict[str, Any]]:
    adjusted = estimate.adjusted
    rows = []
    for name in estimate.names:
        for board in sorted({view.board for view in estimate.views}):
            chosen = [
                i for i, v in enumerate(estimate.views) if (v.camera, v.board) == (name, board)
            ]
            if chosen:
                rows.append({"camera": name, "board": board, **residual_figures(adjusted, chosen)})
    return rows


def residual_figures(adjusted: Any, views: Sequence[int]) -> dict[str, Any]:
    """Figures of some of a bundle's views: how many, how many wrong, residuals of the others."""
    import numpy as np

    chosen = np.isin(adjusted.bundle.view, views)
    used = chosen & adjusted.used
    wrong = len(np.unique(adjusted.bundle.view[chosen & ~adjusted.used]))
    residuals = adjusted.residuals[used]
    return {
        "views": len(views),
        "left_out": wrong,
        "rms_px": float(np.sqrt(np.mean(residuals**2))) if len(residuals) else None,
        "max_px": float(np.linalg.norm(residuals, axis=1).max()) if len(residuals) else None,
    }


def print_table(rows: Sequence[dict[str, Any]]) -> None:
    """Print rows with the same keys in columns."""
    words = [list(rows[0])] + [
        [f"{v:.4f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows
    ]
    widths = [max(len(row[k]) for row in words) for k in range(len(words[0]))]
    for row in words:
        print("  ".join(word.rjust(width) for word, width in zip(row, widths)))


def _print_sigmas(kind: str, names: Sequence[str], covariance: Any) -> None:
    import numpy as np

    sigmas = np.sqrt(np.diagonal(covariance)).reshape(-1, 6)
    for name, row in zip(names, sigmas):
        print(
            f"{kind} {name}: sigma {1e3 * np.linalg.norm(row[:3]):.2f} mm, "
            f"{np.degrees(np.linalg.norm(row[3:])):.4f} deg"
        )


def print_rig_sigmas(estimate: RigEstimate) -> None:
    """Print how sure each marker's pose is."""
    names = [str(marker) for marker in estimate.rig.ids]
    _print_sigmas("marker", names, estimate.rig.covariance)


def _write_json(path: Path, content: dict[str, Any], force: bool) -> None:
    from groundtruth.calibration import write_json

    write_json(path, content, overwrite=force)
