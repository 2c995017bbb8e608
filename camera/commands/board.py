"""``camera board``: a board, or discs, as a PDF at true scale."""

from __future__ import annotations

from camera.boards.board import Board as Printed
from camera.boards.printing import PAGES, page_for, pdf_of, sheet_of_board, sheet_of_discs
from camera.options import Board
from redetect.storage import OutputExistsError, write_whole


def perform(options: Board) -> int:
    """Carry the command out; returns the exit code."""
    if options.output.exists() and not options.force:
        raise OutputExistsError(options.output)
    if options.board == "discs":
        sheet = sheet_of_discs(options.circle_m, options.columns, options.rows)
    else:
        sheet = sheet_of_board(
            Printed(
                kind=options.board,
                columns=options.columns,
                rows=options.rows,
                square_m=options.square_m,
                marker_m=options.marker_m,
                dictionary=options.dictionary,
                circle_m=options.circle_m,
            )
        )
    width, height = page_for(sheet, options.page)
    with write_whole(options.output, overwrite=options.force) as stream:
        stream.write(pdf_of(sheet, (width, height)))
    name = next(name for name, sides in PAGES.items() if set(sides) == {width, height})
    print(f"written: {options.output}: {sheet.text}, on {name}; print at 100 %, measure the bar")
    return 0
