"""Markers in rendered frames: corner errors, detection rate, false ones, time; beside OpenCV's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from redetect.storage import write_whole
from tools.benchmark.material import decode, jpeg_picture
from tools.benchmark.report import Time, spread, times_of
from tools.benchmark.timing import measure_in_turn
from tools.evaluation.markers_statistics import (
    FOUND,
    MISIDENTIFIED,
    OURS,
    PEERS,
    ScoredFrame,
    binned,
    bins_json,
    bins_lines,
    counts_lines,
    detector_of,
    known_to_opencv,
    scored_frame,
    statistics_picture,
    table_of,
)
from tools.evaluation.tables import write_json
from tools.simulator.markers.samples import SampleFrame, SampleSettings, sample_frame
from tools.simulator.markers.things import photograph_files
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


class Offence(NamedTuple):
    """Something that must not happen, and where it did."""

    detector: str
    kind: str
    place: str


def score_frames(
    settings: SampleSettings, detectors: tuple[str, ...], frames: int, seed: int, jobs: int = 1
) -> list[ScoredFrame]:
    """Render frames and let detectors search them."""
    return list(in_order(_score, (settings, detectors, seed), range(frames), jobs))


def _score(state: tuple[SampleSettings, tuple[str, ...], int], index: int) -> ScoredFrame:
    settings, detectors, seed = state
    frame = sample_frame(settings, seed, index)
    found = {name: detector_of(name)(frame.image, frame.camera, frame.dictionary)
             for name in detectors}  # fmt: skip
    return scored_frame(frame, found)


def offences(frames: Sequence[ScoredFrame]) -> list[Offence]:
    """All false and misidentified markers in rendered frames."""
    result = []
    for frame in frames:
        place = f"seed {frame.seed} frame {frame.index} {frame.dictionary}"
        for name, outcome in frame.outcomes.items():
            result += [Offence(name, "false", f"{place} id {i}") for i in outcome.false]
            for row in frame.rows[outcome.status == MISIDENTIFIED]:
                about = (
                    f"width {row[0]:.0f} px slant {row[1]:.0f} blur {row[2]:.1f} px "
                    f"contrast {row[3]:.0f} clear {row[6]:.0f}"
                )
                result.append(Offence(name, "misidentified", f"{place} {about}"))
    return result


def search_photographs(
    folders: Sequence[Path], detector: str, dictionaries: tuple[str, ...], jobs: int = 1
) -> tuple[int, list[Offence]]:
    """Search photographs without markers: how many there were, and what was found.

    Raises
    ------
    ValueError
        If a folder holds no images, or one cannot be read.
    """
    files = [file for folder in folders for file in photograph_files(folder)]
    found = in_order(_search, (detector, dictionaries), files, jobs)
    return len(files), [offence for of_one in found for offence in of_one]


def _search(state: tuple[str, tuple[str, ...]], path: Path) -> list[Offence]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(f"{path}: cannot be read as an image")
    name, dictionaries = state
    return [
        Offence(name, "false", f"{path.name} {dictionary} id {i}")
        for dictionary in dictionaries
        for i in detector_of(name)(np.asarray(image, dtype=np.uint8), None, dictionary).ids
    ]


def time_searches(
    settings: SampleSettings, frames: int, seed: int, *, rounds: int = 5
) -> list[Time]:
    """Time the search of rendered frames, decoding them, and OpenCV's detectors, in turn.

    The frames are those of the statistics, stored as JPEG files of quality 90. Our detector is
    timed twice: with no width given, and with the median width of the frame's markers.
    """
    from detect.markers.candidates import closing
    from detect.markers.detect import detect_markers
    from detect.settings import MarkerSettings

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

    def peer(name: str) -> Callable[[int], object]:
        detect = detector_of(name)
        return lambda i: detect(sampled[i].image, sampled[i].camera, dictionary)

    def close(radius: int) -> Callable[[int], object]:
        return lambda i: closing(sampled[i].image, radius)

    functions: dict[str, Callable[[int], object]] = {
        DECODING: lambda i: decode(encoded[i]),
        SEARCH: lambda i: detect_markers(sampled[i].image, plain, sampled[i].camera),
        GIVEN_WIDTH: lambda i: detect_markers(sampled[i].image, given[i], sampled[i].camera),
        **{f"closing, radius {radius} px": close(radius) for radius in _RADII_PX},
        **{name: peer(name) for name in (_TIMED_PEERS if known_to_opencv(dictionary) else ())},
    }
    seconds = measure_in_turn(functions, frames, rounds, _BUDGET_S)
    return times_of("markers", dictionary, seconds, DECODING)


def timing_lines(times: Sequence[Time]) -> list[str]:
    """A table: times in decodings of the same image, with quartiles, and in milliseconds."""
    width = max(len(time.function) for time in times)
    return [
        f"{time.function:>{width}}: {spread(time.decodings)} x decoding, {time.ms.median:.3g} ms"
        for time in times
    ]


@dataclass(frozen=True)
class Markers:
    """Markers in rendered frames: corner errors, detection rate, false ones; beside OpenCV's ArUco.

    Four parts: statistics of `--statistics` frames with one dictionary, all detectors; the
    processor time of searching `--timing` of these frames; a search for false and misidentified
    markers in `--frames` frames of many dictionaries; photographs below `--photographs`, on which
    everything found is false. Exit code 1 if anything is.
    """

    statistics: int = 1000  # Frames for the statistics; 0 leaves them out.
    dictionary: str = "6x6_250"  # Of the statistics; without OpenCV where it does not know it.
    spot: bool = True  # Also measure the corners of markers some 60 px wide at noise sigma 3.
    timing: int = 0  # Frames to time the detectors on, beside decoding; 0 leaves that out.
    frames: int = 0  # Frames to search for false and misidentified markers.
    dictionaries: tuple[str, ...] = _SEARCHED  # Of that search, and of the photographs'.
    backgrounds: Path | None = None  # Photographs behind half the frames of that search.
    photographs: tuple[Path, ...] = ()  # Folders of photographs without markers to search.
    seed: int = 1  # Of all frames.
    jobs: int = 1  # Processes.
    output: Path | None = None  # Folder for markers.json and statistics.png.
    force: bool = False  # Replace files that exist.

    def __call__(self) -> int:
        content: dict[str, Any] = {
            "settings": {
                "statistics": self.statistics, "dictionary": self.dictionary,
                "frames": self.frames, "dictionaries": list(self.dictionaries),
                "photographic_backgrounds": self.backgrounds is not None, "seed": self.seed,
            }
        }  # fmt: skip
        wrong: list[Offence] = []
        picture = b""
        if self.statistics:
            content["statistics"], found, picture = self._statistics()
            wrong += found
            if self.spot:
                content["spot"] = self._spot()
        if self.timing:
            settings = SampleSettings(dictionaries=(self.dictionary,), samples=_MEASURED_SAMPLES)
            times = time_searches(settings, self.timing, self.seed)
            print(f"Processor time, {self.timing} frames of the statistics")
            print("\n".join(timing_lines(times)))
            content["timing"] = [asdict(time) for time in times]
        if self.frames:
            content["search"], found = self._search_frames()
            wrong += found
        if self.photographs:
            count, found = search_photographs(self.photographs, OURS, self.dictionaries, self.jobs)
            print(
                f"{count} photographs, each searched for {len(self.dictionaries)} dictionaries: "
                f"{len(found)} false markers"
            )
            print("\n".join(_offence_lines(found)))
            content["photographs"] = {"photographs": count, "offences": _offences_json(found)}
            wrong += found
        if self.output is not None:
            self.output.mkdir(parents=True, exist_ok=True)
            if picture:
                place = self.output / "statistics.png"
                with write_whole(place, overwrite=self.force) as stream:
                    stream.write(picture)
            write_json(self.output / "markers.json", content, overwrite=self.force)
        return 1 if wrong else 0

    def _scored(self, settings: SampleSettings, frames: int) -> list[ScoredFrame]:
        """Frames that all detectors have searched."""
        detectors = (OURS, *(PEERS if known_to_opencv(self.dictionary) else ()))
        return score_frames(settings, detectors, frames, self.seed, self.jobs)

    def _statistics(self) -> tuple[dict[str, Any], list[Offence], bytes]:
        settings = SampleSettings(dictionaries=(self.dictionary,), samples=_MEASURED_SAMPLES)
        frames = self._scored(settings, self.statistics)
        table, bins = table_of(frames), binned(table_of(frames))
        own = [offence for offence in offences(frames) if offence.detector == OURS]
        print(f"Statistics, dictionary {self.dictionary}, seed {self.seed}")
        print("\n".join([*counts_lines(table), *bins_lines(bins), *_offence_lines(own)]))
        content = {
            "frames": table.frames,
            "false": {name: len(of.false) for name, of in table.outcomes.items()},
            "repeated": {name: of.repeated for name, of in table.outcomes.items()},
            "bins": bins_json(bins), "offences": _offences_json(own),
        }  # fmt: skip
        title = (
            f"{table.frames} rendered frames, {int(table.columns['clear'].sum())} markers of "
            f"{self.dictionary} clearly in view: widths 12-200 px, slant to 70 deg, blur 0.3-3 px, "
            "contrast 15-200, noise 1-5"
        )
        return content, own, statistics_picture(bins, title)

    def _spot(self) -> dict[str, Any]:
        """Corners at a width of 60 px and a noise of 3: any light and blur, and good light."""
        common = SampleSettings(
            dictionaries=(self.dictionary,), samples=_MEASURED_SAMPLES, empty=0.0, markers=(2, 4),
            width_px=(58.0, 62.0), noise_grey=(3.0, 3.0),
        )  # fmt: skip
        good = replace(common, contrast_grey=(100.0, 200.0), blur_px=(0.5, 1.3), motion=0.0)
        cases = {"any light and blur": common, "contrast 100-200, blur 0.5-1.3 px, still": good}
        content = {}
        for label, settings in cases.items():
            frames = self._scored(settings, max(20, self.statistics // 5))
            everything = binned(table_of(frames))[:1]
            print("\n".join([f"Width 58-62 px, noise 3, {label}", *bins_lines(everything)]))
            content[label] = bins_json(everything)[0]
        return content

    def _search_frames(self) -> tuple[dict[str, Any], list[Offence]]:
        settings = SampleSettings(
            dictionaries=self.dictionaries, samples=_SEARCHED_SAMPLES, photographs=self.backgrounds
        )
        frames = score_frames(settings, (OURS,), self.frames, self.seed, self.jobs)
        table, found = table_of(frames), offences(frames)
        empty = sum(len(frame.rows) == 0 for frame in frames)
        print(f"Search of {len(frames)} frames, {empty} of them without any marker")
        print("\n".join(counts_lines(table)))
        by_dictionary = {}
        for name in self.dictionaries:
            chosen = [frame for frame in frames if frame.dictionary == name]
            clear = [frame.rows[:, 6] > 0.0 for frame in chosen]
            status = [frame.outcomes[OURS].status for frame in chosen]
            by_dictionary[name] = figures = {
                "frames": len(chosen),
                "clear": int(sum(c.sum() for c in clear)),
                "found": int(sum((c & (s == FOUND)).sum() for c, s in zip(clear, status))),
                "misidentified": int(sum((s == MISIDENTIFIED).sum() for s in status)),
                "false": sum(len(frame.outcomes[OURS].false) for frame in chosen),
            }
            print(f"{name:>16}: " + ", ".join(f"{key} {value}" for key, value in figures.items()))
        print("\n".join(_offence_lines(found)))
        content = {
            "frames": len(frames), "without_markers": empty,
            "false": {name: len(of.false) for name, of in table.outcomes.items()},
            "by_dictionary": by_dictionary, "offences": _offences_json(found),
        }  # fmt: skip
        return content, found


def _offence_lines(found: list[Offence]) -> list[str]:
    lines = [f"  {one.detector}: {one.kind}: {one.place}" for one in found[:_SHOWN]]
    return lines + ([f"  ... and {len(found) - _SHOWN} more"] if len(found) > _SHOWN else [])


def _offences_json(found: list[Offence]) -> list[dict[str, str]]:
    return [offence._asdict() for offence in found]
