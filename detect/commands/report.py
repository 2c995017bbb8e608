"""The command ``detect report``: files of rows in, one HTML page out."""

from __future__ import annotations

from detect.options import Report
from detect.report.page import gather, report_page
from detect.sources.opening import demand_recording, open_source
from redetect.storage import demand_place, write_bytes


def perform(options: Report) -> int:
    """Execute the command; returns the exit code."""
    demand_recording(options.run)
    run = open_source(options.run, options.camera, options.source)
    output = run.output("html") if options.output is None else options.output
    demand_place(output, overwrite=options.force)
    inputs = gather(run, options.files)
    write_bytes(output, report_page(inputs, options.worst), overwrite=options.force)
    names = [path.name for path in inputs.files.reference.values()]
    against = f" against {' and '.join(names)}" if names else ", no reference rows"
    print(f"{output}: {len(inputs.rows)} frames, {', '.join(inputs.files.detected)}{against}")
    return 0
