"""Markers in rendered frames: corner errors, detection rate, false ones, time; beside OpenCV's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from detect.markers.candidates import closing
from detect.markers.detect import detect_markers
from detect.settings import MarkerSettings
from tools.benchmark.material import decode, jpeg_picture
from tools.benchmark.timing import decodings, measure_in_turn
from tools.evaluation.figures import WRONG, Figures, Study
from tools.evaluation.markers_statistics import (
    FOUND,
    MISIDENTIFIED,
    OURS,
    PEERS,
    ScoredFrame,
    bins_of,
    counts_lines,
    known_to_opencv,
    print_bins,
    scored_frame,
    search,
    table_of,
)
from tools.evaluation.tables import Table
from tools.simulator.markers.samples import SampleFrame, SampleSettings, sample_frame
from tools.simulator.markers.things import photograph_files, photograph_of
from tools.simulator.parallel import in_order

#: Dictionaries of the search for false markers: all kinds, small and large.
_SEARCHED = (
    "rawseeds", "artoolkitplus12", "artoolkitplus8", "4x4_50", "5x5_100", "6x6_250", "7x7_1000",
    "aruco_original", "apriltag_16h5", "apriltag_25h9", "apriltag_36h11",
)  # fmt: skip
#: Rays in each quarter of a pixel: many where errors are measured, few where frames are searched.
_MEASURED_SAMPLES, _SEARCHED_SAMPLES = 32, 8
_SHOWN = 40

DECODING, SEARCH, GIVEN_WIDTH = "decoding", "redetect", "redetect, width given"
#: Those of OpenCV's refinements that take different times.
_TIMED_PEERS = tuple(name for name in PEERS if name.startswith("aruco"))
#: Radii of closings, pixels.
_RADII_PX = (4, 32)
#: Of functions that are slow, seconds.
_BUDGET_S = 20.0
#: Width that is given where a frame has no marker, pixels.
_WIDTH_WITHOUT_MARKER_PX = 60.0


def score_frames(
    settings: SampleSettings, detectors: tuple[str, ...], frames: int, seed: int, jobs: int = 1
) -> list[ScoredFrame]:
    """Render frames and let detectors search them."""
    return list(in_order(partial(_score, settings, detectors, seed), range(frames), jobs))


def _score(
    settings: SampleSettings, detectors: tuple[str, ...], seed: int, index: int
) -> ScoredFrame:
    frame = sample_frame(settings, seed, index)
    shown = frame.image, frame.camera, frame.dictionary
    return scored_frame(frame, {name: search(name, *shown) for name in detectors})


def offences(frames: Sequence[ScoredFrame]) -> list[str]:
    """All false and misidentified markers that we found in rendered frames."""
    result = []
    for frame in frames:
        place = f"seed {frame.seed} frame {frame.index} {frame.dictionary}"
        outcome = frame.outcomes[OURS]
        result += [f"{OURS}: false: {place} id {i}" for i in outcome.false]
        for row in frame.rows[outcome.status == MISIDENTIFIED]:
            about = (
                f"width {row[0]:.0f} px slant {row[1]:.0f} blur {row[2]:.1f} px "
                f"contrast {row[3]:.0f} clear {row[6]:.0f}"
            )
            result.append(f"{OURS}: misidentified: {place} {about}")
    return result


def search_photographs(
    folders: Sequence[Path], detector: str, dictionaries: tuple[str, ...], jobs: int = 1
) -> tuple[int, list[str]]:
    """Search photographs without markers: how many there were, and what was found.

    Raises
    ------
    ValueError
        If a folder holds no images, or one cannot be read.
    """
    files = [file for folder in folders for file in photograph_files(folder)]
    found = in_order(partial(_search, detector, dictionaries), files, jobs)
    return len(files), [offence for of_one in found for offence in of_one]


def _search(name: str, dictionaries: tuple[str, ...], path: Path) -> list[str]:
    image = photograph_of(path)
    return [
        f"{name}: false: {path.name} {dictionary} id {i}"
        for dictionary in dictionaries
        for i in search(name, image, None, dictionary).ids
    ]


def time_searches(
    settings: SampleSettings, frames: int, seed: int, *, rounds: int = 5
) -> dict[str, Any]:
    """Time the search of rendered frames, decoding them, and OpenCV's detectors, in turn.

    The frames are those of the statistics, stored as JPEG files of quality 90. Our detector is
    timed twice: with no width given, and with the median width of the frame's markers. Prints, and
    returns, medians and quartiles of the times in those of decoding, and milliseconds.
    """
    cv2.setNumThreads(1)
    (dictionary,) = settings.dictionaries
    sampled: list[SampleFrame] = []
    encoded, given = [], []
    plain = MarkerSettings(dictionary=dictionary)
    for index in range(frames):
        frame = sample_frame(settings, seed, index)
        picture = jpeg_picture(frame.image)
        sampled.append(replace(frame, image=picture.grey))
        encoded.append(picture.encoded)
        widths = [marker.width_px for marker in frame.markers] or [_WIDTH_WITHOUT_MARKER_PX]
        given.append(replace(plain, width_px=float(np.median(widths))))

    def peer(name: str, i: int) -> object:
        return search(name, sampled[i].image, sampled[i].camera, dictionary)

    def close(radius: int, i: int) -> object:
        return closing(sampled[i].image, radius)

    peers = _TIMED_PEERS if known_to_opencv(dictionary) else ()
    functions: dict[str, Callable[[int], object]] = {
        DECODING: lambda i: decode(encoded[i]),
        SEARCH: lambda i: detect_markers(sampled[i].image, plain, sampled[i].camera),
        GIVEN_WIDTH: lambda i: detect_markers(sampled[i].image, given[i], sampled[i].camera),
        **{f"closing, radius {radius} px": partial(close, radius) for radius in _RADII_PX},
        **{name: partial(peer, name) for name in peers},
    }
    seconds = measure_in_turn(functions, frames, rounds, _BUDGET_S)
    columns = ("decodings", "lower", "upper", "ms")
    table = Table({"": "<24", **dict.fromkeys(columns, "8.2f")})
    for name, of in decodings(seconds, DECODING).items():
        table.row(name, of["median"], of["lower"], of["upper"], of["ms"])
    return table.figures


@dataclass(frozen=True)
class Markers(Study):
    """Markers in rendered frames: corner errors, recall, false ones, compared with OpenCV's ArUco.

    Four parts: statistics of `--statistics` frames with one dictionary, for all detectors; the
    processor time for `--timing` of these frames; a search for false and misidentified
    markers in `--frames` frames of many dictionaries; photographs below `--photographs`, in which
    all detections are false. The exit code is 1 if there are false ones.
    """

    statistics: int = 1000  # Number of frames for the statistics; 0: none.
    dictionary: str = "6x6_250"  # Of the statistics; without OpenCV if that does not know it.
    spot: bool = True  # Also measure the corners of markers about 60 px wide at noise sigma 3.
    timing: int = 0  # Number of frames for measuring times, compared with decoding; 0: none.
    frames: int = 0  # Number of frames to search for false and misidentified markers.
    dictionaries: tuple[str, ...] = _SEARCHED  # Of that search, and of the photographs'.
    backgrounds: Path | None = None  # Photographs as backgrounds of half the frames of that search.
    photographs: tuple[Path, ...] = ()  # Folders of photographs without markers to search.
    seed: int = 1  # Of all frames.
    jobs: int = 1  # Number of processes.

    def measure(self) -> Figures:
        wrong: list[str] = []
        figures: dict[str, Any] = {}
        measured = SampleSettings(dictionaries=(self.dictionary,), samples=_MEASURED_SAMPLES)
        if self.statistics:
            frames = self._scored(measured, self.statistics)
            table = table_of(frames)
            print(f"Statistics, dictionary {self.dictionary}, seed {self.seed}")
            print("\n".join(counts_lines(table)))
            figures["statistics"] = print_bins(table, bins_of(table))
            wrong += _printed(offences(frames))
            if self.spot:
                figures["spot"] = self._spot(measured)
        if self.timing:
            print(f"Processor time in decodings, {self.timing} frames of the statistics")
            figures["timing"] = time_searches(measured, self.timing, self.seed)
        if self.frames:
            figures["frames"], found = self._search_frames()
            wrong += _printed(found)
        if self.photographs:
            count, found = search_photographs(self.photographs, OURS, self.dictionaries, self.jobs)
            print(
                f"{count} photographs, each searched for {len(self.dictionaries)} dictionaries: "
                f"{len(found)} false markers"
            )
            figures["photographs"] = {"photographs": count, "false": len(found)}
            wrong += _printed(found)
        return {WRONG: len(wrong), **figures}

    def _scored(self, settings: SampleSettings, frames: int) -> list[ScoredFrame]:
        """Frames that all detectors have searched."""
        detectors = (OURS, *(PEERS if known_to_opencv(self.dictionary) else ()))
        return score_frames(settings, detectors, frames, self.seed, self.jobs)

    def _spot(self, measured: SampleSettings) -> dict[str, Any]:
        """Corners at a width of 60 px and a noise of 3: any light and blur, and good light."""
        common = replace(
            measured, empty=0.0, markers=(2, 4), width_px=(58.0, 62.0), noise_grey=(3.0, 3.0)
        )
        good = replace(common, contrast_grey=(100.0, 200.0), blur_px=(0.5, 1.3), motion=0.0)
        cases = {"any light and blur": common, "contrast 100-200, blur 0.5-1.3 px, still": good}
        figures = {}
        for label, settings in cases.items():
            print(f"Width 58-62 px, noise 3, {label}")
            table = table_of(self._scored(settings, max(20, self.statistics // 5)))
            figures[label] = print_bins(table, {"all": bins_of(table)["all"]})["all"]
        return figures

    def _search_frames(self) -> tuple[dict[str, Any], list[str]]:
        settings = SampleSettings(
            dictionaries=self.dictionaries, samples=_SEARCHED_SAMPLES, photographs=self.backgrounds
        )
        frames = score_frames(settings, (OURS,), self.frames, self.seed, self.jobs)
        print(f"Search of {len(frames)} frames")
        columns = ("frames", "empty", "markers", "clear", "found", "misidentified", "false")
        printed = Table({"dictionary": "<16", **dict.fromkeys(columns, "d")})
        for name in (*self.dictionaries, "all"):
            if chosen := [frame for frame in frames if name in (frame.dictionary, "all")]:
                table = table_of(chosen)
                outcome, clear = table.outcomes[OURS], table.columns["clear"] > 0.0
                printed.row(
                    name, table.frames, sum(len(frame.rows) == 0 for frame in chosen), len(clear),
                    clear.sum(), (clear & (outcome.status == FOUND)).sum(),
                    (outcome.status == MISIDENTIFIED).sum(), len(outcome.false),
                )  # fmt: skip
        return printed.figures, offences(frames)


def _printed(found: list[str]) -> list[str]:
    for one in found[:_SHOWN]:
        print(f"  {one}")
    if len(found) > _SHOWN:
        print(f"  ... and {len(found) - _SHOWN} more")
    return found
