"""The commands ``detect report`` and ``demo``: a page about a run."""

from __future__ import annotations

from pathlib import Path

from detect.commands.run import perform as detect_run
from detect.comparison.compare import compare_run
from detect.options import All, Demo, Report, RowFiles
from detect.report.page import gather, report_page
from detect.sources.opening import demand_recording, open_source
from redetect.messages import counted
from redetect.storage import demand_free, demand_place, write_bytes

#: Images included in the program: the first ones of the demo run (`images/README.md`).
DEMO_RUN = Path(__file__).resolve().parents[2] / "redetect" / "demo"


def perform_report(options: Report) -> int:
    """Write a page about a run; returns the exit code."""
    demand_recording(options.run)
    run = open_source(options.run, options.camera, options.source)
    output = run.output("html") if options.output is None else options.output
    demand_place(output, overwrite=options.force)
    inputs = gather(run, options.files)
    write_bytes(output, report_page(inputs, options.worst), overwrite=options.force)
    names = [path.name for path in inputs.files.reference.values()]
    against = f" against {' and '.join(names)}" if names else ", no reference rows"
    frames = counted(len(inputs.rows), "frame")
    print(f"{output}: {frames}, {', '.join(inputs.files.detected)}{against}")
    return 0


def perform_demo(command: Demo) -> int:
    """Detect a small run, compare it with the truth, write a page; returns the exit code."""
    run = command.run or DEMO_RUN
    page = command.output / "demo.html"
    demand_free([page], overwrite=command.force)
    print(f"{run}: rendered images of a robot's drive")
    code = detect_run(All(run=run, output=command.output, force=command.force))
    if code != 0:
        return code
    result = compare_run(run, detected=command.output / "detected.circles")
    perform_report(
        Report(run=run, output=page, files=RowFiles(rows=command.output), force=command.force)
    )
    print("", *result.sentences(), sep="\n")
    return 0
