"""The command ``detect report``: files of rows in, one page out."""

from __future__ import annotations

from detect.errors import DetectError
from detect.report.inputs import gather
from detect.report.page import report_page
from detect.sources.opening import demand_recording, open_source
from detect.viewing_options import Report
from redetect.storage import OutputExistsError, write_whole


def perform(options: Report) -> int:
    """Carry the command out; returns the exit code."""
    if options.worst < 0:
        raise DetectError(f"worst is {options.worst}: expected 0 or more")
    demand_recording(options.run)
    run = open_source(options.run, options.camera, options.source)
    output = run.output("html") if options.output is None else options.output
    if output.exists() and not options.force:
        raise OutputExistsError(output)
    inputs = gather(run, options.files, options.gates, options.time_frames)
    page = report_page(inputs, options.worst)
    with write_whole(output, overwrite=options.force) as stream:
        stream.write(page)
    names = [path.name for path in inputs.files.reference.values()]
    against = f" against {' and '.join(names)}" if names else ", no reference rows"
    print(f"{output}: {len(inputs.rows)} frames, {', '.join(inputs.files.detected)}{against}")
    return 0
