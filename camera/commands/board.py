"""``camera board``: a page to print."""

from __future__ import annotations

from camera.boards.board import board_of, pdf_of, sheet_of_board, sheet_of_discs
from camera.options import Board
from redetect.storage import demand_place, write_bytes


def perform(command: Board) -> int:
    """Execute the command; returns the exit code."""
    demand_place(command.output, overwrite=command.force)
    if command.board == "discs":
        sheet = sheet_of_discs(command.circle_m, command.columns, command.rows)
    else:
        sheet = sheet_of_board(board_of(command))
    write_bytes(command.output, pdf_of(sheet), overwrite=command.force)
    print(f"written: {command.output}: {sheet.text}; print at 100 %, measure the bar")
    return 0
