"""Common parts of the commands: checks of outputs, metadata, progress."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from redetect.groundtruth import __version__
from redetect.groundtruth.errors import GroundTruthError
from redetect.storage import OutputExistsError, write_whole


def check_outputs(paths: Sequence[Path | None], force: bool) -> None:
    """Refuse to begin where an output exists, unless it may be replaced, or two are one file."""
    places: set[Path] = set()
    for path in paths:
        if path is None:
            continue
        if path.exists() and not force:
            raise OutputExistsError(path)
        if path.resolve() in places:
            raise GroundTruthError(
                f"{path}: two of the outputs would be written there: expected another name or "
                "ending"
            )
        places.add(path.resolve())


def provenance(settings: Any, files: Sequence[Path] = ()) -> dict[str, Any]:
    """Metadata of a result: version, settings, and the files that it depends on."""
    return {
        "version": __version__,
        "settings": asdict(settings),
        "files": {
            path.name: {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()} for path in files
        },
    }


def write_account(path: Path, content: dict[str, Any], *, overwrite: bool) -> None:
    """Write the metadata of a result as JSON."""
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write((json.dumps(content, indent=1) + "\n").encode())


@contextmanager
def progress(label: str) -> Iterator[tuple[Callable[[int], None], Callable[[], None]]]:
    """A progress bar on a terminal; yields a function to set the total and one to advance."""
    # The file is checked: environment variables can make rich take a log for a terminal, and of a
    # disabled bar, older versions of it print the line's end.
    if not sys.stderr.isatty():
        yield lambda total: None, lambda: None
        return
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
    with bar:
        task = bar.add_task(label, total=None)
        yield lambda total: bar.update(task, total=total), lambda: bar.advance(task)
