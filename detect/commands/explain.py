"""The command ``detect explain``: an image in; a table, a picture and suggestions out."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table

from camera import camera_in, read_camera
from detect.drawing.frame import draw_explanation, png_of
from detect.errors import DetectError
from detect.explanation import DiscExplanation, explain_discs
from detect.options import Explain
from detect.runs.outputs import lean_sentence
from detect.sources.grey_images import read_image
from detect.sources.interface import RunFrame, still
from redetect.messages import counted
from redetect.storage import demand_place, write_bytes

#: Number of candidates in the table.
_SHOWN = 40


def perform(command: Explain) -> int:
    """Execute the command; returns the exit code."""
    for path in (command.output, command.json):
        if path is not None:
            demand_place(path, overwrite=command.force)
    if not command.detector.refine:
        raise DetectError(
            "--no-refine: centres are rejected for their quality only: nothing else to explain"
        )
    if not command.image.is_file():
        raise DetectError(f"{command.image}: no such image: expected one image of a run")
    folders = command.image.absolute().parents[:2]
    named = command.camera and read_camera(command.camera)
    camera = named or next(filter(None, map(camera_in, folders)), None)
    if camera is None:
        raise DetectError(
            f"{command.image}: no calibration: expected a .cam file in its folder or the one "
            "above, or one named by --camera"
        )
    frame = RunFrame(still("image"), command.image, bit_depth=command.bit_depth)
    found = explain_discs(read_image(frame, camera), camera, command.detector, command.at)
    _print(found)
    if command.output is not None:
        write_bytes(command.output, png_of(draw_explanation(found)), overwrite=command.force)
        print(f"{command.output}: {counted(len(found.candidates), 'candidate')}")
    if command.json is not None:
        write_bytes(command.json, f"{found.to_json()}\n".encode(), overwrite=command.force)
    return 0


def _print(found: DiscExplanation) -> None:
    console = Console()
    if found.lean is not None:
        console.print(lean_sentence(found.lean), highlight=False, markup=False)
    if found.place:
        console.print(found.place, highlight=False, markup=False)
    table = Table(box=box.SIMPLE_HEAD, padding=0)
    for heading in ("", "u", "v", "ahead m", "left m", "votes", "contrast"):
        table.add_column(heading, justify="right")
    table.add_column("result")
    for number, row in enumerate(found.candidates[:_SHOWN], start=1):
        figures = f"{row.u:.0f} {row.v:.0f} {-row.y_m:.2f} {row.x_m:.2f} {row.votes:.1f}"
        contrast = f"{row.contrast:+.0f}" if row.contrast == row.contrast else "-"
        table.add_row(str(number), *figures.split(), contrast, row.reason())
    console.print(table if found.candidates else "No candidate for a disc.")
    if len(found.candidates) > _SHOWN:
        console.print(f"{len(found.candidates) - _SHOWN} more with fewer votes: --at U V, --json")
    for words in found.suggestions:
        console.print(f"Try: {words}", highlight=False, markup=False)
