"""Whole runs: files in, files out, through what the command ``detect`` carries out."""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from detect.cli import carry_out
from detect.options import All, Circles, Lines
from detect.run import open_run
from detect.settings import PUBLISHED
from tools.benchmark.errors import BenchmarkError
from tools.benchmark.material import decode
from tools.benchmark.timing import FloatArray, measure_in_turn

Command = All | Circles | Lines
Key = TypeVar("Key", bound=Hashable)

#: A command that has taken this long is left out of later rounds, seconds.
_BUDGET_S = 15.0


def commands(run: Path, output: Path, jobs: int = 1) -> dict[str, Command]:
    """The commands that are measured on a run, by name; their files go into a folder."""
    return {
        "detect circles --preset published": Circles(
            run=run, output=output / "published.circles", force=True, jobs=jobs, settings=PUBLISHED
        ),
        "detect circles": Circles(run=run, output=output / "discs.circles", force=True, jobs=jobs),
        "detect lines": Lines(run=run, output=output / "verticals.lines", force=True, jobs=jobs),
        "detect all": All(run=run, output=output, force=True, jobs=jobs),
    }


def perform(command: Command) -> None:
    """Carry out a command as ``detect`` does, but silently.

    Raises
    ------
    BenchmarkError
        If it does not end well.
    """
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = carry_out(command)
    if code != 0:
        report = " ".join(said.getvalue().split())
        raise BenchmarkError(f"detect ended with {code}: expected 0: {report}")


def decode_run(files: Sequence[NDArray[np.uint8]]) -> None:
    """Decode all of a run's files, already in memory, and do nothing with them."""
    for content in files:
        decode(content)


def read_and_decode_run(paths: Sequence[Path]) -> None:
    """Read and decode all of a run's files, and do nothing with them."""
    for path in paths:
        with path.open("rb", buffering=0) as stream:
            decode(np.frombuffer(stream.readall(), np.uint8))


def contents_of(paths: Sequence[Path]) -> list[NDArray[np.uint8]]:
    """What files hold; files that are one under several names are held once."""
    held: dict[tuple[int, int], NDArray[np.uint8]] = {}
    contents = []
    for path in paths:
        status = path.stat()
        key = (status.st_dev, status.st_ino)
        if key not in held:
            held[key] = np.fromfile(path, np.uint8)
        contents.append(held[key])
    return contents


def measure_runs(
    performed: Mapping[Key, Command],
    run: Path,
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
    *,
    warm_up: bool = True,
) -> tuple[int, FloatArray, FloatArray, dict[Key, FloatArray]]:
    """Time whole passes over a run, in turn with decoding its files, from memory and from the disk.

    Parameters
    ----------
    performed : mapping
        Commands by any key, all on `run`.
    run : path
        The run folder.
    rounds : int
        Passes; slow commands get fewer.
    clock : callable
        Seconds; by default of the clock on the wall, since jobs are processes of their own.
    warm_up : bool
        Whether a pass of each command is made beforehand that is not measured.

    Returns
    -------
    frames : int
    decoding : (rounds,) float64
        Seconds of decoding the run, whose files are in memory.
    reading : (rounds,) float64
        Seconds of reading its files and decoding them.
    seconds : dict of (rounds,) float64
        Seconds of each command; NaN where it was left out.
    """
    opened = open_run(run)
    paths = [frame.image for frame in opened.frames if frame.image is not None]
    files = contents_of(paths)

    def performing(command: Command) -> Callable[[int], object]:
        return lambda _: perform(command)

    functions: dict[str, Callable[[int], object]] = {
        "decoding": lambda _: decode_run(files),
        "reading": lambda _: read_and_decode_run(paths),
    }
    functions |= {str(i): performing(command) for i, command in enumerate(performed.values())}
    seconds = measure_in_turn(
        functions, 1, rounds, _BUDGET_S, clock, warm_up=warm_up, least_calls=1
    )
    by_key = {key: seconds[str(i)][:, 0] for i, key in enumerate(performed)}
    return len(paths), seconds["decoding"][:, 0], seconds["reading"][:, 0], by_key
