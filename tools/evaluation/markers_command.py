"""The subcommand ``markers`` of the evaluation."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import tyro

from redetect.storage import OutputExistsError, write_whole
from tools.evaluation.markers import Offence, offences, score_frames, search_photographs
from tools.evaluation.markers_detectors import OURS, PEERS, known_to_opencv
from tools.evaluation.markers_report import bins_lines, counts_lines, statistics_picture
from tools.evaluation.markers_scoring import ScoredFrame, table_of
from tools.evaluation.markers_statistics import binned, bins_json
from tools.evaluation.markers_timing import time_searches, timing_lines
from tools.simulator.markers.sampling import SampleSettings

T = TypeVar("T")

#: Dictionaries of the search for false markers: all kinds, small and large.
_HUNTED = (
    "rawseeds", "artoolkitplus12", "artoolkitplus8", "4x4_50", "5x5_100", "6x6_250", "7x7_1000",
    "aruco_original", "apriltag_16h5", "apriltag_25h9", "apriltag_36h11",
)  # fmt: skip
#: Rays in each quarter of a pixel: many where errors are measured, few where frames are searched.
_MEASURED_SAMPLES, _HUNTED_SAMPLES = 32, 8
_SHOWN = 40


@dataclass(frozen=True)
class Markers:
    """Markers in rendered frames: corner errors, detection rate, false ones; beside OpenCV's ArUco.

    Four parts: statistics of `--statistics` frames with one dictionary, all detectors; the
    processor time of searching `--timing` of these frames; a search for false and misidentified
    markers in `--frames` frames of many dictionaries; photographs below `--photographs`, on which
    everything found is false. Exit code 1 if anything is.
    """

    statistics: int = 1000
    """Frames for the statistics; 0 leaves them out."""
    dictionary: str = "6x6_250"
    """Dictionary of the statistics; OpenCV's detectors are left out where they do not know it."""
    spot: bool = True
    """Also measure the corners of markers some 60 px wide at noise sigma 3."""
    timing: int = 0
    """Frames to time the detectors on, beside decoding; 0 leaves that out."""
    frames: int = 0
    """Frames to search for false and misidentified markers."""
    dictionaries: tuple[str, ...] = _HUNTED
    """Dictionaries of that search, and of the photographs'."""
    backgrounds: Path | None = None
    """Folder of photographs to be backgrounds of half the frames of that search."""
    photographs: tuple[Path, ...] = ()
    """Folders of photographs without markers to search."""
    peers: bool = False
    """Let OpenCV's detector search as well; what it finds wrong is counted but is no failure."""
    seed: int = 1
    """Of all frames."""
    jobs: int = 1
    """Processes."""
    output: Path | None = None
    """Folder for the figures (markers.json) and the picture (statistics.png)."""
    force: bool = False
    """Replace files that exist."""


def perform(command: Markers) -> int:
    """Run the parts asked for; 1 if our detector found anything false."""
    try:
        return _perform(command)
    except (OutputExistsError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _perform(command: Markers) -> int:
    content: dict[str, Any] = {"settings": _settings_json(command)}
    files: dict[str, bytes] = {}
    wrong: list[Offence] = []
    if command.statistics:
        wrong += _statistics(command, content, files)
        if command.spot:
            _spot(command, content)
    if command.timing:
        _timing(command, content)
    if command.frames:
        wrong += _hunt(command, content)
    if command.photographs:
        wrong += _photographs(command, content)
    if command.output is not None:
        command.output.mkdir(parents=True, exist_ok=True)
        files["markers.json"] = (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()
        for name, data in files.items():
            with write_whole(command.output / name, overwrite=command.force) as stream:
                stream.write(data)
    return 1 if any(offence.detector == OURS for offence in wrong) else 0


def _detectors(command: Markers) -> tuple[str, ...]:
    return (OURS, *(PEERS if known_to_opencv(command.dictionary) else ()))


def _statistics(
    command: Markers, content: dict[str, Any], files: dict[str, bytes]
) -> list[Offence]:
    settings = SampleSettings(dictionaries=(command.dictionary,), samples=_MEASURED_SAMPLES)
    frames = _scored(command, settings, _detectors(command), command.statistics, "statistics")
    table, found = table_of(frames), offences(frames)
    bins = binned(table)
    print(f"Statistics, dictionary {command.dictionary}, seed {command.seed}")
    _print(counts_lines(table))
    _print(bins_lines(bins))
    _print_offences([o for o in found if o.detector == OURS])
    content["statistics"] = {
        "frames": table.frames,
        "false": table.false,
        "repeated": table.repeated,
        "bins": bins_json(bins),
        "offences": [asdict(o) for o in found if o.detector == OURS],
    }
    title = (
        f"{table.frames} rendered frames, {int(table.columns['clear'].sum())} markers of "
        f"{command.dictionary} clearly in view: widths 12-200 px, slant to 70 deg, blur 0.3-3 px, "
        "contrast 15-200, noise 1-5"
    )
    files["statistics.png"] = statistics_picture(bins, title)
    return found


def _spot(command: Markers, content: dict[str, Any]) -> None:
    """Corners at a width of 60 px and a noise of 3: any light and blur, and good light."""
    common: dict[str, Any] = {
        "dictionaries": (command.dictionary,), "samples": _MEASURED_SAMPLES, "empty": 0.0,
        "markers": (2, 4), "width_px": (58.0, 62.0), "noise_grey": (3.0, 3.0),
    }  # fmt: skip
    cases = {
        "any light and blur": SampleSettings(**common),
        "contrast 100-200, blur 0.5-1.3 px, still": SampleSettings(
            **common, contrast_grey=(100.0, 200.0), blur_px=(0.5, 1.3), motion=0.0
        ),
    }
    content["spot"] = {}
    for label, settings in cases.items():
        count = max(20, command.statistics // 5)
        frames = _scored(command, settings, _detectors(command), count, "width 60 px")
        everything = binned(table_of(frames))[:1]
        print(f"Width 58-62 px, noise 3, {label}")
        _print(bins_lines(everything))
        content["spot"][label] = bins_json(everything)[0]


def _timing(command: Markers, content: dict[str, Any]) -> None:
    settings = SampleSettings(dictionaries=(command.dictionary,), samples=_MEASURED_SAMPLES)
    times = _with_progress(
        "rendering",
        command.timing,
        lambda tick: time_searches(settings, command.timing, command.seed, on_frame=tick),
    )
    print(f"Processor time, {command.timing} frames of the statistics")
    _print(timing_lines(times))
    content["timing"] = [asdict(timed) for timed in times]


def _hunt(command: Markers, content: dict[str, Any]) -> list[Offence]:
    settings = SampleSettings(
        dictionaries=command.dictionaries,
        samples=_HUNTED_SAMPLES,
        photographs=command.backgrounds,
    )
    detectors: tuple[str, ...] = (OURS,)
    if command.peers and all(map(known_to_opencv, command.dictionaries)):
        detectors = (OURS, PEERS[0])
    frames = _scored(command, settings, detectors, command.frames, "search")
    table, found = table_of(frames), offences(frames)
    empty = sum(len(frame.rows) == 0 for frame in frames)
    print(f"Search of {len(frames)} frames, {empty} of them without any marker")
    _print(counts_lines(table))
    by_dictionary = {}
    for name in command.dictionaries:
        chosen = [frame for frame in frames if frame.dictionary == name]
        rows = np.concatenate([f.rows for f in chosen]) if chosen else np.zeros((0, 7))
        clear = rows[:, 6] > 0.0
        status = (
            np.concatenate([f.outcomes[OURS].status for f in chosen]) if chosen else np.zeros(0)
        )
        figures = {
            "frames": len(chosen),
            "clear": int(clear.sum()),
            "found": int(np.count_nonzero(clear & (status == 1))),
            "misidentified": int(np.count_nonzero(status == 2)),
            "false": sum(len(f.outcomes[OURS].false) for f in chosen),
        }
        by_dictionary[name] = figures
        print(f"{name:>16}: " + ", ".join(f"{key} {value}" for key, value in figures.items()))
    _print_offences(found)
    content["search"] = {
        "frames": len(frames),
        "without_markers": empty,
        "false": table.false,
        "by_dictionary": by_dictionary,
        "offences": [asdict(o) for o in found],
    }
    return found


def _photographs(command: Markers, content: dict[str, Any]) -> list[Offence]:
    detectors = (OURS,)
    count, found = _with_progress(
        "photographs",
        None,
        lambda tick: search_photographs(
            command.photographs, detectors, command.dictionaries, jobs=command.jobs,
            on_photograph=tick,
        ),
    )  # fmt: skip
    print(
        f"{count} photographs, each searched for {len(command.dictionaries)} dictionaries: "
        f"{len(found)} false markers"
    )
    _print_offences(found)
    content["photographs"] = {"photographs": count, "offences": [asdict(o) for o in found]}
    return found


def _scored(
    command: Markers,
    settings: SampleSettings,
    detectors: tuple[str, ...],
    count: int,
    label: str,
) -> list[ScoredFrame]:
    return _with_progress(
        label,
        count,
        lambda tick: score_frames(
            settings, detectors, frames=count, seed=command.seed, jobs=command.jobs, on_frame=tick
        ),
    )


def _settings_json(command: Markers) -> dict[str, Any]:
    """What decides the figures: neither where they go nor by how many processes they are made."""
    return {
        "statistics": command.statistics,
        "dictionary": command.dictionary,
        "frames": command.frames,
        "dictionaries": list(command.dictionaries),
        "photographic_backgrounds": command.backgrounds is not None,
        "seed": command.seed,
    }


def _print(lines: list[str]) -> None:
    for line in lines:
        print(line)


def _print_offences(found: list[Offence]) -> None:
    for offence in found[:_SHOWN]:
        print(f"  {offence.detector}: {offence.kind}: {offence.place}")
    if len(found) > _SHOWN:
        print(f"  ... and {len(found) - _SHOWN} more")


def _with_progress(label: str, total: int | None, work: Callable[[Callable[[], None]], T]) -> T:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(label, total=total)
        return work(lambda: progress.advance(task))


#: As the command line takes it.
MarkersCommand = Annotated[Markers, tyro.conf.subcommand("markers")]
