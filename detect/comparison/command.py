"""The command ``detect compare``: compares detected rows with reference rows."""

from __future__ import annotations

import sys

from rich.console import Console

from camera import read_camera
from detect.comparison.circles import Sight, beside_reference, compare_runs
from detect.comparison.lines import compare_line_runs
from detect.comparison.report import comparison_tables, format_json
from detect.comparison.result import (
    Comparison,
    LineCompareOptions,
    LineComparison,
    unmet_demands,
)
from detect.drawing.inputs import read_head
from detect.errors import DetectError
from detect.options import Compare
from detect.run import camera_in
from storage import write_whole
from storage.exit_codes import EXIT_ERROR


def perform(command: Compare) -> int:
    """Compare rows with reference rows; returns the exit code."""
    _demand_rows(command)
    result = _compared_lines(command) if command.lines else _compared_discs(command)
    Console().print(comparison_tables(result))
    if command.json is not None:
        with write_whole(command.json, overwrite=command.force) as stream:
            stream.write(format_json(result).encode())
    unmet = unmet_demands(
        result, min_recall=command.min_recall, min_precision=command.min_precision
    )
    for sentence in unmet:
        print(sentence, file=sys.stderr)
    return EXIT_ERROR if unmet else 0


def _demand_rows(command: Compare) -> None:
    """Refuse missing files, with a message that says how to make them."""
    if command.lines and (command.unlisted or command.lookalikes):
        raise DetectError("--unlisted and --lookalikes are of discs: expected neither with --lines")
    kind = "lines" if command.lines else "circles"
    reference = command.reference or command.run / f"map.{kind}"
    detected = command.detected or command.run / f"detected.{kind}"
    if not reference.exists():
        raise DetectError(
            f"{reference}: no such landmark file: give the reference rows with --reference"
        )
    if not detected.exists():
        raise DetectError(
            f"{detected}: no such landmark file: `detect {kind}` writes it, --detected names "
            "another"
        )


def _compared_discs(command: Compare) -> Comparison:
    sight = _sight(command)
    if sight is None and not command.options.on_floor:
        print("no calibration: positions are compared on the floor; --camera names one")
    return compare_runs(
        command.run,
        reference=command.reference,
        detected=command.detected,
        options=command.options,
        sight=sight,
        beside=beside_reference(
            command.reference or command.run / "map.circles", command.unlisted, command.lookalikes
        ),
    )


def _sight(command: Compare) -> Sight | None:
    """How rows come back into the images; None without a calibration."""
    camera = camera_in(command.run) if command.camera is None else read_camera(command.camera)
    if camera is None:
        return None
    reference = read_head(command.reference or command.run / "map.circles")
    detected = read_head(command.detected or command.run / "detected.circles")
    return Sight(camera, detected.circle_settings.radius_m, reference.level)


def _compared_lines(command: Compare) -> LineComparison:
    options = LineCompareOptions(
        tolerance_deg=command.tolerance_deg,
        sigmas=command.sigmas,
        only_identified=command.options.only_identified,
        all_frames=command.options.all_frames,
    )
    return compare_line_runs(
        command.run, reference=command.reference, detected=command.detected, options=options
    )
