"""The command ``detect compare``: compares detected rows with reference rows."""

from __future__ import annotations

import sys

from rich.console import Console

from camera import Camera, camera_in, read_camera
from detect.comparison.compare import compare_with_file, read_kind
from detect.comparison.report import comparison_tables
from detect.comparison.result import Comparison, DiscComparison, Kind
from detect.errors import DetectError
from detect.options import Compare
from detect.projection import DiscProjection
from detect.row_files import circle_settings_of
from redetect.command_line import EXIT_ERROR
from redetect.landmarks.files import read_head
from redetect.storage import write_bytes


def perform(command: Compare) -> int:
    """Compare rows with reference rows; returns the exit code."""
    result = comparison_of(command)
    if isinstance(result, DiscComparison) and not (result.in_image or command.matching.gate_m):
        print("no calibration: positions are compared on the floor; give one by --camera")
    Console().print(comparison_tables(result))
    if command.json is not None:
        write_bytes(command.json, result.to_json().encode(), overwrite=command.force)
    code = 0
    for name, value, least in (
        ("recall", result.recall, command.min_recall),
        ("precision", result.precision, command.min_precision),
    ):
        if least is not None and (value is None or value < least):
            shown = "unknown" if value is None else f"{value:.4f}"
            print(f"{name} is {shown}: expected at least {least:g}", file=sys.stderr)
            code = EXIT_ERROR
    return code


def comparison_of(command: Compare, camera: Camera | None = None) -> Comparison:
    """The comparison for a command; `camera` replaces the file that the command names."""
    kind: Kind = "lines" if command.lines else "circles"
    reference = command.reference or command.run / f"map.{kind}"
    detected = command.detected or command.run / f"detected.{kind}"
    for path, advice in (
        (reference, "give the reference rows with --reference"),
        (detected, f"`detect {kind}` writes it, or give another with --detected"),
    ):
        if not path.exists():
            raise DetectError(f"{path}: no such landmark file: {advice}")
    projection = None
    if not command.lines:
        if camera is None:
            named = command.camera
            camera = camera_in(command.run) if named is None else read_camera(named)
        settings, level = circle_settings_of(read_head(detected)), read_head(reference).level
        if camera is not None:
            projection = DiscProjection(camera, settings, level)
    return compare_with_file(
        kind,
        reference,
        read_kind(kind, detected),
        command.matching,
        projection=projection,
        unlisted=command.unlisted,
        names=(str(reference), str(detected)),
    )
