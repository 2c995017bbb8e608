"""Common parts of the commands: checks of outputs, metadata, progress, tables."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console
from rich.progress import track

from redetect import __version__
from redetect.storage import demand_distinct, demand_free

T = TypeVar("T")


def check_outputs(paths: Sequence[Path | None], force: bool) -> None:
    """Raise an error if an output exists and must not be replaced, or two are the same file."""
    given = [path for path in paths if path is not None]
    demand_distinct(given)
    demand_free(given, overwrite=force)


def remove_old(paths: Sequence[Path | None], force: bool) -> None:
    """Remove outputs of an earlier run that this one, which may replace them, does not write."""
    for path in paths:
        if force and path is not None and path.is_file():
            path.unlink()


def warn(text: str) -> None:
    """Print a warning."""
    print(f"warning: {text}", file=sys.stderr)


def provenance(settings: Any, files: Sequence[Path] = ()) -> dict[str, Any]:
    """Version, settings, and the files on which a result depends, by name or, if equal, by path."""
    names = [path.name for path in files]
    keys = [name if names.count(name) == 1 else str(path) for name, path in zip(names, files)]
    hashes = [{"sha256": hashlib.sha256(path.read_bytes()).hexdigest()} for path in files]
    return {"version": __version__, "settings": settings, "files": dict(zip(keys, hashes))}


def progress(items: Sequence[T], label: str) -> Iterable[T]:
    """The items one after the other, with a progress bar on a terminal."""
    # The file is checked: environment variables can make rich treat a log as a terminal, and its
    # older versions print the line end of a disabled bar.
    if not sys.stderr.isatty():
        return items
    return track(items, label, console=Console(stderr=True))


def print_table(rows: Sequence[dict[str, Any]]) -> None:
    """Print rows with the same keys in columns."""
    words = [list(rows[0])] + [
        [f"{v:.4f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows
    ]
    widths = [max(len(row[k]) for row in words) for k in range(len(words[0]))]
    for row in words:
        print("  ".join(word.rjust(width) for word, width in zip(row, widths)))


def print_sigmas(kind: str, names: Sequence[str], covariance: Any) -> None:
    """Print the standard deviations of each pose, from a (6 N, 6 N) covariance."""
    for name, row in zip(names, np.sqrt(np.diagonal(covariance)).reshape(-1, 6)):
        print(
            f"{kind} {name}: sigma {1e3 * np.linalg.norm(row[:3]):.2f} mm, "
            f"{np.degrees(np.linalg.norm(row[3:])):.4f} deg"
        )
