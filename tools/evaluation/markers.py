"""Markers: statistics against the truth, and the search for false and misidentified ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.evaluation.markers_detectors import Found, detector_of
from tools.evaluation.markers_scoring import (
    MISIDENTIFIED,
    ScoredFrame,
    score_frame,
    scored_frame,
)
from tools.simulator.markers.backgrounds import photograph_files
from tools.simulator.markers.sampling import SampleSettings, sample_frame


@dataclass(frozen=True)
class Work:
    """A frame to be rendered and searched."""

    settings: SampleSettings
    detectors: tuple[str, ...]
    seed: int
    index: int


def score_frames(
    settings: SampleSettings,
    detectors: tuple[str, ...],
    *,
    frames: int,
    seed: int,
    jobs: int = 1,
    on_frame: Callable[[], None] | None = None,
) -> list[ScoredFrame]:
    """Render frames and let detectors search them.

    Parameters
    ----------
    settings : SampleSettings
        What the frames are to be like.
    detectors : tuple of str
        Names that `markers_detectors.detector_of` knows.
    frames, seed : int
        Frames 0 to frames - 1 of that seed.
    jobs : int
        Processes.
    on_frame : callable, optional
        Called after each frame.

    Returns
    -------
    list of ScoredFrame
    """
    work = [Work(settings, detectors, seed, index) for index in range(frames)]
    scored = []
    for frame in _mapped(_score, work, jobs):
        scored.append(frame)
        if on_frame is not None:
            on_frame()
    return scored


def _score(work: Work) -> ScoredFrame:
    frame = sample_frame(work.settings, work.seed, work.index)
    outcomes = {
        name: score_frame(
            frame.markers, detector_of(name)(frame.image, frame.camera, frame.dictionary)
        )
        for name in work.detectors
    }
    return scored_frame(frame, outcomes)


@dataclass(frozen=True, eq=False)
class Offence:
    """Something that must not happen: where it did, so that it can be looked at."""

    detector: str
    kind: str
    place: str


def offences(frames: Sequence[ScoredFrame]) -> list[Offence]:
    """All false and misidentified markers in rendered frames."""
    result = []
    for frame in frames:
        place = f"seed {frame.seed} frame {frame.index} {frame.dictionary}"
        for name, outcome in frame.outcomes.items():
            result += [Offence(name, "false", f"{place} id {i}") for i in outcome.false]
            wrong = frame.rows[outcome.status == MISIDENTIFIED]
            result += [
                Offence(
                    name,
                    "misidentified",
                    f"{place} width {row[0]:.0f} px slant {row[1]:.0f} blur {row[2]:.1f} px "
                    f"contrast {row[3]:.0f} clear {row[6]:.0f}",
                )
                for row in wrong
            ]
    return result


@dataclass(frozen=True)
class _Photograph:
    path: Path
    detectors: tuple[str, ...]
    dictionaries: tuple[str, ...]


def search_photographs(
    folders: Sequence[Path],
    detectors: tuple[str, ...],
    dictionaries: tuple[str, ...],
    *,
    jobs: int = 1,
    on_photograph: Callable[[], None] | None = None,
) -> tuple[int, list[Offence]]:
    """Search photographs on which there is no marker.

    Parameters
    ----------
    folders : sequence of path
        All images below them are searched.
    detectors, dictionaries : tuple of str
        Every photograph is searched by each detector for each dictionary.
    jobs : int
        Processes.
    on_photograph : callable, optional
        Called after each photograph.

    Returns
    -------
    photographs : int
        How many there were.
    offences : list of Offence
        Markers that were found.

    Raises
    ------
    ValueError
        If a folder holds no images, or one cannot be read.
    """
    work = []
    for folder in folders:
        files = photograph_files(folder)
        if not files:
            raise ValueError(f"{folder}: holds no photographs (.jpg, .png)")
        work += [_Photograph(path, detectors, dictionaries) for path in files]
    found: list[Offence] = []
    for offences_here in _mapped(_search, work, jobs):
        found += offences_here
        if on_photograph is not None:
            on_photograph()
    return len(work), found


def _search(work: _Photograph) -> list[Offence]:
    import cv2

    decoded = cv2.imread(str(work.path), cv2.IMREAD_GRAYSCALE)
    if decoded is None:
        raise ValueError(f"{work.path}: cannot be read as an image")
    image: NDArray[np.uint8] = np.asarray(decoded, dtype=np.uint8)
    result = []
    for name in work.detectors:
        for dictionary in work.dictionaries:
            found: Found = detector_of(name)(image, None, dictionary)
            result += [
                Offence(name, "false", f"{work.path.name} {dictionary} id {i}") for i in found.ids
            ]
    return result


def _mapped(function: Callable, work: Sequence, jobs: int) -> Iterator:  # type: ignore[type-arg]
    """Results in order."""
    if jobs <= 1:
        yield from (function(item) for item in work)
        return
    import multiprocessing

    context = multiprocessing.get_context("spawn")
    with context.Pool(jobs, _start_worker) as pool:
        yield from pool.imap(function, work, chunksize=4)


def _start_worker() -> None:
    import cv2

    cv2.setNumThreads(1)
