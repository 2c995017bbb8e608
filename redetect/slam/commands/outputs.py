"""Output of the filters' commands: a summary, pictures, and the filter's time."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

from redetect.landmarks.map_file import LandmarkMap, Path2D
from redetect.slam.filters.frames import FilterRun
from redetect.slam.options import FilterFlags
from redetect.slam.pictures import draw_errors, draw_map
from redetect.storage import OutputExistsError, write_whole

PATH_NAME, MAP_PICTURE, ERROR_PICTURE = "path.csv", "map.png", "errors.png"


def demand_free(folder: Path, names: tuple[str, ...], *, overwrite: bool) -> None:
    """Refuse before the work what could not be written after it, and make the folder."""
    for name in names:
        if (folder / name).exists() and not overwrite:
            raise OutputExistsError(folder / name)
    folder.mkdir(parents=True, exist_ok=True)


def timed(work: Callable[[], FilterRun]) -> tuple[FilterRun, str]:
    """Take a filter through a run; also returned is what to print of its time."""
    began, began_working = time.perf_counter(), time.thread_time()
    run = work()
    seconds, working = time.perf_counter() - began, time.thread_time() - began_working
    steps = len(run.path.poses) - 1
    return run, (
        f"time              {seconds:.2f} s, {steps / seconds:.0f} steps/s; of processor "
        f"{working:.2f} s, {steps / working:.0f} steps/s"
    )


def write_json(path: Path, content: dict[str, object], *, overwrite: bool) -> None:
    """Write a summary."""
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write((json.dumps(content, indent=1) + "\n").encode())


def draw_results(
    output: Path,
    landmark_map: LandmarkMap,
    path: Path2D,
    reference: Path2D | None,
    title: str,
    flags: FilterFlags,
) -> None:
    """Draw the map with the path and, beside a reference, the distance from it."""
    draw_map(
        output / MAP_PICTURE,
        landmark_map,
        path,
        reference=reference,
        title=title,
        overwrite=flags.force,
        interactive=flags.interactive,
    )
    if reference is not None:
        draw_errors(
            output / ERROR_PICTURE,
            path,
            reference.poses,
            title=title,
            overwrite=flags.force,
            interactive=flags.interactive,
        )
