"""The command ``detect compare``: compares detected rows with reference rows."""

from __future__ import annotations

import sys
from pathlib import Path

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
    reference, detected = _files(command)
    compared = _compared_lines if command.lines else _compared_discs
    result = compared(command, reference, detected)
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


def _files(command: Compare) -> tuple[Path, Path]:
    """Reference and detected rows; missing ones are refused, saying how to make them."""
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
    return reference, detected


def _compared_discs(command: Compare, reference: Path, detected: Path) -> Comparison:
    camera = camera_in(command.run) if command.camera is None else read_camera(command.camera)
    sight = None
    if camera is not None:
        level = read_head(reference).level
        sight = Sight(camera, read_head(detected).circle_settings.radius_m, level)
    elif not command.options.on_floor:
        print("no calibration: positions are compared on the floor; --camera names one")
    beside = beside_reference(reference, command.unlisted, command.lookalikes)
    return compare_runs(
        command.run,
        reference=reference,
        detected=detected,
        options=command.options,
        sight=sight,
        beside=beside,
    )


def _compared_lines(command: Compare, reference: Path, detected: Path) -> LineComparison:
    options = LineCompareOptions(
        tolerance_deg=command.tolerance_deg,
        sigmas=command.sigmas,
        only_identified=command.options.only_identified,
        all_frames=command.options.all_frames,
    )
    return compare_line_runs(command.run, reference=reference, detected=detected, options=options)
