"""The command ``detect demo``: a small run, its comparison with the truth, and a page."""

from __future__ import annotations

from pathlib import Path

from detect.commands.compare import comparison_of
from detect.commands.report import perform as write_report
from detect.commands.run import perform as detect_run
from detect.options import All, Compare, Demo, Report, RowFiles
from redetect.storage import demand_free

#: Images included in the program: the first ones of the demo run (`images/README.md`).
DEMO_RUN = Path(__file__).resolve().parents[2] / "redetect" / "demo"


def perform(command: Demo) -> int:
    """Execute the command; returns the exit code."""
    run = command.run or DEMO_RUN
    page = command.output / "demo.html"
    demand_free([page], overwrite=command.force)
    print(f"{run}: rendered images of a robot's drive")
    code = detect_run(All(run=run, output=command.output, force=command.force))
    if code != 0:
        return code
    result = comparison_of(Compare(run=run, detected=command.output / "detected.circles"))
    write_report(
        Report(run=run, output=page, files=RowFiles(rows=command.output), force=command.force)
    )
    print("", *result.sentences(), sep="\n")
    return 0
