"""The command ``detect compare``: rows against reference rows."""

from __future__ import annotations

import sys

from rich.console import Console

from detect.comparison.compare import compare_run
from detect.comparison.report import comparison_tables
from detect.comparison.result import DiscComparison
from detect.errors import CompareError
from detect.options import Compare
from redetect.command_line import EXIT_ERROR
from redetect.storage import demand_place, write_bytes


def perform(command: Compare) -> int:
    """Compare rows with reference rows; returns the exit code."""
    if command.lines and (command.camera or command.matching.gate_m):
        raise CompareError("--camera, --gate-m: expected discs, not --lines: for them, bearings")
    if command.json is not None:
        demand_place(command.json, overwrite=command.force)
    result = compare_run(
        command.run,
        "lines" if command.lines else "circles",
        command.detected,
        command.reference,
        camera=command.camera,
        options=command.matching,
        unlisted=command.unlisted,
    )
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
