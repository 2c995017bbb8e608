"""The command ``groundtruth score``: errors of poses against the truth; loads no pictures."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from redetect.groundtruth.commands.outputs import check_outputs
from redetect.groundtruth.files import write_json
from redetect.groundtruth.options import Score
from redetect.groundtruth.trajectories import streams
from redetect.groundtruth.validation import scoring


def perform(command: Score) -> int:
    """Carry out ``groundtruth score``; returns the exit code."""
    check_outputs((command.json,), command.force)
    solution, truth = map(streams.read_planar_poses, (command.poses, command.truth))
    relations = None if command.relations is None else scoring.read_relations(command.relations)
    poses, truth, unmatched = streams.matched_streams(
        solution, truth, largest_gap_s=command.largest_gap_s, interpolate=command.interpolate
    )
    alignment = streams.planar_alignment(poses, truth) if command.align else None
    if alignment is not None:
        poses = streams.moved_poses(poses, alignment)
    score = scoring.score_poses(poses, truth, unmatched)
    print(f"poses              {score.poses} ({score.unmatched} without the other at their time)")
    print(*score.lines(), sep="\n")
    relative = {}
    if relations is not None:
        relative["relations"] = scoring.score_relations(solution, relations, command.largest_gap_s)
    if command.rpe_step is not None:
        steps = scoring.score_steps(poses, truth, command.rpe_step, command.rpe_longest_s)
        relative[f"steps of {command.rpe_step}"] = steps
    for name, figures in relative.items():
        print(
            f"relative error, {name}: {figures.pairs} pairs ({figures.unmatched} left out), "
            f"rmse {1e3 * figures.position_rmse_m:.2f} mm, median "
            f"{1e3 * figures.position_median_m:.2f}, max {1e3 * figures.position_max_m:.2f}; "
            f"rmse {math.degrees(figures.angle_rmse_rad):.3f} deg"
        )
    if command.json is not None:
        values: dict[str, Any] = asdict(score)
        if alignment is not None:
            values["alignment"] = alignment.tolist()
        if relative:
            values["relative"] = {name: asdict(figures) for name, figures in relative.items()}
        write_json(command.json, values, overwrite=command.force)
    return 0
