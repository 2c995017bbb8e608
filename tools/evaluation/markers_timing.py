"""Processor time of searching an image for markers, beside decoding it and OpenCV's detectors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tools.benchmark.material import decode, jpeg_picture
from tools.benchmark.timing import Spread, measure_in_turn, paired_ratios, spread_of
from tools.evaluation.markers_detectors import PEERS, detector_of, known_to_opencv
from tools.simulator.markers.sampling import SampleFrame, SampleSettings, sample_frame

DECODING = "decoding"
SEARCH = "redetect"
GIVEN_WIDTH = "redetect, width given"
#: Those of OpenCV's refinements that take different times.
_PEERS = tuple(name for name in PEERS if name.startswith("aruco"))
#: Radii of closings, pixels.
_RADII_PX = (4, 32)
_ROUNDS = 5
#: Of functions that are slow, seconds.
_BUDGET_S = 20.0
#: Width that is looked for where a frame has no marker, pixels.
_WIDTH_WITHOUT_MARKER_PX = 60.0


@dataclass(frozen=True)
class Timed:
    """Time of a function on many images.

    Attributes
    ----------
    name : str
    ratio : Spread
        To decoding the same image in the same round.
    milliseconds : Spread
    """

    name: str
    ratio: Spread
    milliseconds: Spread


def time_searches(
    settings: SampleSettings,
    frames: int,
    seed: int,
    *,
    rounds: int = _ROUNDS,
    on_frame: Callable[[], None] | None = None,
) -> list[Timed]:
    """Time the search of rendered frames, decoding them, and OpenCV's detectors, in turn.

    The frames are those of the statistics, stored as JPEG files of quality 90. Our detector is
    timed twice: with no width given, and told the median width of the frame's markers.

    Parameters
    ----------
    settings : SampleSettings
        What the frames are to be like; with one dictionary.
    frames, seed : int
        Frames 0 to frames - 1 of that seed.
    rounds : int
        How often each function gets each image.
    on_frame : callable, optional
        Called after each frame is rendered.

    Returns
    -------
    list of Timed
    """
    import cv2

    from detect.markers.candidates import closing
    from detect.markers.detect import detect_markers
    from detect.markers.settings import MarkerSettings

    cv2.setNumThreads(1)
    (dictionary,) = settings.dictionaries
    sampled: list[SampleFrame] = []
    encoded = []
    for index in range(frames):
        frame = sample_frame(settings, seed, index)
        picture = jpeg_picture(frame.image)
        sampled.append(replace(frame, image=picture.grey))
        encoded.append(picture.encoded)
        if on_frame is not None:
            on_frame()
    plain = MarkerSettings(dictionary=dictionary)
    told = [replace(plain, width_px=_width_px(frame)) for frame in sampled]

    def peer(name: str) -> Callable[[int], object]:
        detect = detector_of(name)
        return lambda i: detect(sampled[i].image, sampled[i].camera, dictionary)

    def close(radius: int) -> Callable[[int], object]:
        return lambda i: closing(sampled[i].image, radius)

    functions: dict[str, Callable[[int], object]] = {
        DECODING: lambda i: decode(encoded[i]),
        SEARCH: lambda i: detect_markers(sampled[i].image, plain, sampled[i].camera),
        GIVEN_WIDTH: lambda i: detect_markers(sampled[i].image, told[i], sampled[i].camera),
        **{f"closing, radius {radius} px": close(radius) for radius in _RADII_PX},
        **{name: peer(name) for name in (_PEERS if known_to_opencv(dictionary) else ())},
    }
    seconds = measure_in_turn(functions, frames, rounds, _BUDGET_S)
    return [
        Timed(
            name,
            spread_of(paired_ratios(values, seconds[DECODING])),
            spread_of(1e3 * values),
        )
        for name, values in seconds.items()
    ]


def timing_lines(times: Sequence[Timed]) -> list[str]:
    """A table: times in decodings of the same image, with quartiles, and in milliseconds."""
    width = max(len(timed.name) for timed in times)
    return [
        f"{timed.name:>{width}}: {timed.ratio.median:.3g} x decoding "
        f"({timed.ratio.lower_quartile:.3g} - {timed.ratio.upper_quartile:.3g}), "
        f"{timed.milliseconds.median:.3g} ms"
        for timed in times
    ]


def _width_px(frame: SampleFrame) -> float:
    widths = [marker.width_px for marker in frame.markers]
    return float(np.median(widths)) if widths else _WIDTH_WITHOUT_MARKER_PX
