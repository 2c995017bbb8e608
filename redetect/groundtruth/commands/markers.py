"""The commands ``groundtruth network`` and ``rig``: poses of cameras, and of markers on a robot."""

from __future__ import annotations

import os
import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from camera import camera_file_in, read_camera
from redetect.bounds import demand
from redetect.groundtruth.commands import outputs
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.markers import session
from redetect.groundtruth.markers.boards import (
    BoardView,
    calibration_of,
    read_boards,
    view_of_board,
)
from redetect.groundtruth.markers.network_estimation import estimate_network
from redetect.groundtruth.markers.rig_estimation import estimate_rig
from redetect.groundtruth.options import Network, Rig
from redetect.groundtruth.report.pictures import draw_rig
from redetect.storage import write_bytes

#: Share of a marker's views above which those left out are warned of.
_MANY_LEFT_OUT = 0.1
#: Standard deviations, and share, by which the width that fits the images differs from that given
#: if a warning is printed: no print is much more accurate than a thousandth.
_WRONG_SIGMAS, _WRONG_SHARE = 5.0, 1e-3


def perform_network(command: Network) -> int:
    """Carry out ``groundtruth network``; returns the exit code."""
    outputs.check_outputs((command.output,), command.force)
    boards = read_boards(command.boards)
    shots: dict[int, list[BoardView]] = {}
    for image in outputs.progress(boards.images, "boards"):
        try:
            view = view_of_board(image, boards.boards[image.board], boards.cameras[image.camera])
            shots.setdefault(image.placement, []).append(view)
        except GroundTruthError as error:
            print(f"left out: {error}", file=sys.stderr)
    estimate = estimate_network(boards, list(shots.values()), command.settings)
    folder = command.boards if command.boards.is_dir() else command.boards.parent
    network = session.Network(
        estimate.names,
        tuple(boards.cameras[name] for name in estimate.names),
        tuple(
            Path(os.path.relpath(folder / calibration_of(name), command.output.parent)).as_posix()
            for name in estimate.names
        ),
        estimate.world_from_camera,
        estimate.covariance,
    )
    adjusted, table = estimate.adjusted, []
    for name, board in product(estimate.names, sorted({view.board for view in estimate.views})):
        chosen = [i for i, v in enumerate(estimate.views) if (v.camera, v.board) == (name, board)]
        if chosen:
            table.append({"camera": name, "board": board, **adjusted.residual_figures(chosen)})
    extra = {
        "made_by": outputs.provenance(command.settings),
        "reduced_cost": adjusted.chi2_per_dof,
        "disagreement": estimate.disagreement,
        "residuals": table,
    }
    session.write_network(command.output, network, extra, overwrite=command.force)
    outputs.print_table(table)
    outputs.print_sigmas("camera", list(estimate.names), estimate.covariance)
    if estimate.disagreement > 1.0:
        outputs.warn(
            "the boards' pictures contradict each other (the standard deviations were multiplied "
            f"by {estimate.disagreement**0.5:.1f}): was a board moved between the pictures of one "
            "placement, or is a calibration, a board's square_m or first_from_second wrong?"
        )
    elif estimate.connections < 1:
        outputs.warn(
            "each connection of cameras is by a single placement: nothing shows whether a board "
            "was moved between its pictures"
        )
    print(f"{command.output}: {len(estimate.names)} cameras")
    return 0


def perform_rig(command: Rig) -> int:
    """Carry out ``groundtruth rig``; returns the exit code."""
    demand(command, GroundTruthError, width_m=session.WIDTH)
    if command.robot is not None and command.reference is not None:
        raise GroundTruthError("--reference is of no use with --robot: expected one of them")
    if not command.runs or len({run.resolve() for run in command.runs}) < len(command.runs):
        raise GroundTruthError("expected one or more run folders, each of them once")
    picture = command.output.with_suffix(".png")
    outputs.check_outputs((command.output, picture), command.force)
    network, groups = _input(command)
    known = None if command.robot is None else session.read_rig(command.robot)
    estimate = estimate_rig(
        groups, network, command.width_m, command.settings, reference=command.reference, known=known
    )
    frame = f"robot, by {command.robot.name}" if command.robot else f"marker {estimate.reference}"
    rig, table = estimate.rig, list[dict[str, Any]]()
    for index, marker in enumerate(rig.ids):
        own = [i for i, view in enumerate(estimate.views) if view.rig_index == index]
        table.append({"marker": marker, **estimate.adjusted.residual_figures(own)})
    extra: dict[str, Any] = {
        "made_by": outputs.provenance(command.settings),
        "frame": frame,
        "times": estimate.times,
        "reduced_cost": estimate.adjusted.chi2_per_dof,
        "residuals": table,
        "pairs": [
            {
                "markers": [rig.ids[a], rig.ids[b]],
                "times": len(pair.agrees),
                "agree": pair.support,
                "agree_with_second_solution": int((pair.agrees & ~pair.first).sum()),
            }
            for (a, b), pair in sorted(estimate.pairs.items())
        ],
    }
    drawn = draw_rig(estimate)
    session.write_rig(command.output, rig, extra, overwrite=command.force)
    write_bytes(picture, drawn, overwrite=command.force)
    for marker, reason in estimate.left_out.items():
        print(f"marker {marker}: left out: {reason}")
    outputs.print_table(table)
    for row in table:
        marker, views, left_out = (row[name] for name in ("marker", "views", "left_out"))
        if left_out > max(_MANY_LEFT_OUT * views, 2):
            outputs.warn(
                f"marker {marker}: {left_out} of {views} views disagree with the others: was it "
                "moved, or misread, or is its width another?"
            )
    width, sigma = estimate.fitting_width_m
    if abs(width - command.width_m) > max(_WRONG_SIGMAS * sigma, _WRONG_SHARE * width):
        outputs.warn(
            f"the cameras of {command.network} see markers {width:.5f} m wide (sigma "
            f"{sigma:.5f} m): --width-m {command.width_m:g}, or the network, is wrong"
        )
    outputs.print_sigmas("marker", [str(marker) for marker in rig.ids], rig.covariance)
    print(
        f"{command.output}: {len(rig.ids)} markers from {estimate.times} times, frame: {frame}, "
        f"squared residuals per degree of freedom {estimate.adjusted.chi2_per_dof:.2f}"
    )
    return 0


def _input(command: Rig) -> tuple[session.Network, list[tuple[session.MarkerFrame, ...]]]:
    """The cameras, and images grouped by time, or separately without a network's file."""
    if command.network is not None:
        network = session.read_network(command.network)
        frames = session.read_network_frames(command.runs, network)
        return network, session.group_by_time(frames, command.settings.time_tolerance_s)
    count, files = len(command.runs), []
    for run in command.runs:
        if (found := camera_file_in(run, how=f"{run.resolve().name}.cam")) is None:
            raise GroundTruthError(f"{run}: no calibration: expected a .cam file in it")
        files.append(found)
    network = session.Network(
        tuple(run.name for run in command.runs),
        tuple(map(read_camera, files)),
        tuple(map(str, files)),
        np.tile(np.eye(4), (count, 1, 1)),
        np.zeros((6 * count, 6 * count)),
    )
    return network, [
        (frame,)
        for index, run in enumerate(command.runs)
        for frame in session.read_marker_frames(run, index, timed=False)
    ]
