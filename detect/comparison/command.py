"""The command ``detect compare``: compares detected rows with reference rows."""

from __future__ import annotations

import sys
from pathlib import Path

from rich.console import Console

from camera import read_camera
from detect.comparison.compare import beside_reference, compare_line_frames, compare_runs
from detect.comparison.report import comparison_tables, format_json
from detect.comparison.result import Comparison, unmet_demands
from detect.drawing.inputs import read_head
from detect.errors import DetectError
from detect.options import Compare
from detect.run import camera_in
from detect.seen import Sight
from redetect.landmarks import read_frames
from redetect.storage import write_whole
from redetect.storage.exit_codes import EXIT_ERROR


def perform(command: Compare) -> int:
    """Compare rows with reference rows; returns the exit code."""
    if command.lines and (command.unlisted or command.lookalikes):
        raise DetectError("--unlisted and --lookalikes are of discs: expected neither with --lines")
    kind = "lines" if command.lines else "circles"
    reference = command.reference or command.run / f"map.{kind}"
    detected = command.detected or command.run / f"detected.{kind}"
    for path, advice in (
        (reference, "give the reference rows with --reference"),
        (detected, f"`detect {kind}` writes it, --detected names another"),
    ):
        if not path.exists():
            raise DetectError(f"{path}: no such landmark file: {advice}")
    result: Comparison
    if command.lines:
        result = compare_line_frames(
            read_frames(reference),
            read_frames(detected),
            command.options,
            names=(str(reference), str(detected)),
        )
    else:
        result = compare_runs(
            command.run,
            reference=reference,
            detected=detected,
            options=command.options,
            sight=_sight(command, reference, detected),
            beside=beside_reference(reference, command.unlisted, command.lookalikes),
        )
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


def _sight(command: Compare, reference: Path, detected: Path) -> Sight | None:
    camera = camera_in(command.run) if command.camera is None else read_camera(command.camera)
    if camera is not None:
        radius_m = read_head(detected).circle_settings.radius_m
        return Sight(camera, radius_m, read_head(reference).level)
    if not command.options.on_floor:
        print("no calibration: positions are compared on the floor; --camera names one")
    return None
