"""The command ``groundtruth network``: files and messages of the cameras' poses."""

from __future__ import annotations

import os
import sys
from itertools import product
from pathlib import Path

from redetect.groundtruth.commands import outputs
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.markers.boards import BoardView, calibration_of, find_boards, read_boards
from redetect.groundtruth.markers.network_estimation import estimate_network
from redetect.groundtruth.markers.session import Network, write_network
from redetect.groundtruth.options import Network as NetworkCommand


def perform(command: NetworkCommand) -> int:
    """Carry out ``groundtruth network``; returns the exit code."""
    outputs.check_outputs((command.output,), command.force)
    boards = read_boards(command.boards)
    shots: dict[int, list[BoardView]] = {}
    for image in outputs.progress(boards.images, "boards"):
        try:
            view = find_boards(image, boards.boards[image.board], boards.cameras[image.camera])
            shots.setdefault(image.placement, []).append(view)
        except GroundTruthError as error:
            print(f"left out: {error}", file=sys.stderr)
    estimate = estimate_network(boards, list(shots.values()), command.settings)
    folder = command.boards if command.boards.is_dir() else command.boards.parent
    calibrations = tuple(
        Path(os.path.relpath(folder / calibration_of(name), command.output.parent)).as_posix()
        for name in estimate.names
    )
    network = Network(
        estimate.names,
        tuple(boards.cameras[name] for name in estimate.names),
        calibrations,
        estimate.world_from_camera,
        estimate.covariance,
    )
    adjusted, table = estimate.adjusted, []
    for name, board in product(estimate.names, sorted({view.board for view in estimate.views})):
        chosen = [i for i, v in enumerate(estimate.views) if (v.camera, v.board) == (name, board)]
        if chosen:
            figures = adjusted.residual_figures(chosen)
            table.append({"camera": name, "board": board, **figures})
    extra = {
        "made_by": outputs.provenance(command.settings),
        "reduced_cost": adjusted.reduced_cost,
        "residuals": table,
    }
    write_network(command.output, network, extra, overwrite=command.force)
    outputs.print_table(table)
    outputs.print_sigmas("camera", list(estimate.names), estimate.covariance)
    print(f"{command.output}: {len(estimate.names)} cameras")
    return 0
