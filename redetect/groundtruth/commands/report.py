"""The command ``groundtruth report``: a session in, one page out."""

from __future__ import annotations

from redetect import __version__
from redetect.groundtruth.commands.outputs import check_outputs, warn
from redetect.groundtruth.options import Report
from redetect.groundtruth.report.inputs import gather
from redetect.groundtruth.report.page import report_page
from redetect.storage import write_bytes


def perform(options: Report) -> int:
    """Execute the command; returns the exit code."""
    output = options.output or options.session / "report.html"
    check_outputs([output], options.force)
    inputs = gather(options.session, options.truth)
    page = report_page(inputs, __version__)
    write_bytes(output, page, overwrite=options.force)
    for problem in inputs.problems:
        warn(problem)
    shown = [*inputs.streams, *(["truth"] if inputs.truth is not None else [])]
    print(f"{output}: {', '.join(shown) or 'no poses'}; {len(inputs.missing)} missing files")
    return 0
