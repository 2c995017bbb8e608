"""Machine-readable log of a run: ``<output>.log.json``.

It states the program and its settings, the frames that could not be processed and why, how much was
found, and the size and hash of the other files. Nothing in it depends on the time of day or on the
workers: the same run writes the same bytes.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from detect.errors import EXIT_FRAMES_FAILED, DetectError
from detect.runs.conduct import Conduct
from detect.runs.frame import FramePlan
from detect.runs.rows import RunSummary
from storage import OutputExistsError

_BEGIN = b'{\n "program": "redetect",'


class FailedFrameError(DetectError):
    """A frame that could not be worked on, where every frame is demanded."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"{reason} (--strict: nothing is written)")


def log_place(output: Path) -> Path:
    """Path of the log of a result."""
    return output.with_name(f"{output.name}.log.json")


def demand_log_place(place: Path, *, overwrite: bool) -> None:
    """Refuse to write a log over a file that is none.

    Raises
    ------
    storage.OutputExistsError
        If there is a file that is no log and must not be overwritten.
    """
    if overwrite or not os.path.lexists(place):
        return
    if place.is_symlink() or not place.is_file():
        raise OutputExistsError(place)
    with place.open("rb") as stream:
        if stream.read(len(_BEGIN)) != _BEGIN:
            raise OutputExistsError(place)


def log_head(plan: FramePlan, conduct: Conduct) -> bytes:
    """The text before the failures."""
    settings = {"circles": plan.circles, "lines": plan.lines, "markers": plan.markers}
    document: dict[str, Any] = {
        "program": "redetect",
        "version": conduct.version,
        "command": conduct.command,
        "camera": None if plan.camera is None else plan.camera.content_hash,
        "settings": {
            name: dataclasses.asdict(values)
            for name, values in settings.items()
            if values is not None
        },
        "failures": [],
    }
    return json.dumps(document, indent=1).rsplit("]", 1)[0].encode()


def log_failure(place: int, prefix: str, reason: str) -> bytes:
    """A frame that could not be worked on: its place in the run, from 0, its name and why."""
    record = json.dumps({"frame": place, "prefix": prefix, "reason": reason})
    return f"\n  {record}".encode()


def log_tail(found: RunSummary, outputs: Sequence[Mapping[str, object]]) -> bytes:
    """The text after the failures; of each output the name, the size and the hash."""
    document = {
        "frames": found.frames,
        "failed": found.failed,
        "images_left_out": found.images_without_step,
        "found": {kind: found.found[kind] for kind in ("discs", "lines", "tilts", "markers")},
        "rejected": dict(sorted(found.rejected.items())),
        "outputs": outputs,
        "exit_code": EXIT_FRAMES_FAILED if found.failed else 0,
    }
    end = "\n ]," if found.failed else "],"
    return f"{end}{json.dumps(document, indent=1)[1:]}\n".encode()
