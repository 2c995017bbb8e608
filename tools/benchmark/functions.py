"""What is measured: decoding, the detectors whole and in part, and peers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from camera import Camera
from detect.circles import detect_circles, disc_shape
from detect.discs.quality import Limits, centres_of, quality_of_centres
from detect.levelling import levelled
from detect.line_settings import DEFAULT as LINES_DEFAULT
from detect.lines import detect_lines
from detect.noise import estimate_noise
from detect.runs.frame import tilt_of_lines
from detect.settings import PUBLISHED, REPORT, CircleSettings
from detect.verticals.response import line_response
from lut import cached_disc_table, cached_vertical_table
from tools.benchmark.material import Picture, decode

#: What everything else is compared with.
DECODING = "decoding"

#: What ratios of one's own parts and of peers are taken between, for the report.
KERNEL = "quality map (report)"
RESPONSE = "response (dense)"
CIRCLES = "circles (default)"
LINES = "lines (default)"
ALL = "lines, tilt and discs"

#: Radii of circles for the Hough transforms, pixels: those of the demo run's discs along u.
_HOUGH_RADII_PX = (6, 60)
_HOUGH_STEP_PX = 6
_CANNY_SIGMA_PX = 2.0
_BLOB_AREA_PX = (30.0, 10_000.0)


@dataclass(frozen=True)
class Measured:
    """A function that is measured.

    Attributes
    ----------
    name : str
        Unique.
    group : str
        "decoding", "circles", "lines", "all" or "peer".
    call : callable
        Given a picture; what it returns is dropped.
    """

    name: str
    group: str
    call: Callable[[Picture], object]


def decoding() -> Measured:
    """Decoding an image file's content, already in memory, to grey values."""
    return Measured(DECODING, "decoding", lambda picture: decode(picture.encoded))


def circle_detectors(camera: Camera, *, parts: bool = True) -> list[Measured]:
    """The disc detector: both presets whole, and (with `parts`) its quality map by itself."""
    published = cached_disc_table(camera, disc_shape(PUBLISHED))
    report = cached_disc_table(camera, disc_shape(REPORT))
    settings = CircleSettings()
    default = cached_disc_table(camera, disc_shape(settings))
    pieces = [
        Measured(KERNEL, "circles", lambda p: quality_of_centres(p.grey, report)),
        Measured("quality map (default)", "circles", lambda p: quality_of_centres(p.grey, default)),
        Measured(
            "good centres (report)",
            "circles",
            lambda p: centres_of(p.grey, report, Limits(REPORT.threshold)),
        ),
        Measured(
            "good centres (default)",
            "circles",
            lambda p: centres_of(p.grey, default, Limits(settings.threshold)),
        ),
        Measured("noise estimate", "circles", lambda p: estimate_noise(p.grey)),
    ]
    whole = [
        Measured(
            "circles (published)",
            "circles",
            lambda p: detect_circles(p.grey, camera, published, PUBLISHED),
        ),
        Measured(CIRCLES, "circles", lambda p: detect_circles(p.grey, camera, default, settings)),
    ]
    return pieces + whole if parts else whole


def line_detectors(camera: Camera, *, parts: bool = True) -> list[Measured]:
    """The detector of verticals: whole, and (with `parts`) its response by itself."""
    table = cached_vertical_table(camera)
    pieces = [Measured(RESPONSE, "lines", lambda p: line_response(p.grey, table, LINES_DEFAULT))]
    whole = [Measured(LINES, "lines", lambda p: detect_lines(p.grey, table, LINES_DEFAULT))]
    return pieces + whole if parts else whole


def both_detectors(camera: Camera) -> Measured:
    """Verticals, their tilt, and discs corrected for it, as `detect all` does it."""
    settings = CircleSettings()
    discs = cached_disc_table(camera, disc_shape(settings))
    verticals = cached_vertical_table(camera)

    def detect(picture: Picture) -> object:
        lines = detect_lines(picture.grey, verticals, LINES_DEFAULT)
        circles = detect_circles(picture.grey, camera, discs, settings)
        tilt = tilt_of_lines("image", lines)
        return lines, circles if tilt is None else levelled(circles, camera, tilt)

    return Measured(ALL, "all", detect)


def peers_of_other_libraries() -> tuple[list[Measured], list[str]]:
    """Detectors of circles and lines of OpenCV and scikit-image.

    Returns
    -------
    present : list of Measured
    absent : list of str
        Names of those that the installed OpenCV has not got.
    """
    import cv2
    from skimage.feature import canny
    from skimage.transform import hough_circle

    low, high = _HOUGH_RADII_PX
    radii = np.arange(low, high + 1, _HOUGH_STEP_PX)
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.blobColor = 255
    parameters.minArea, parameters.maxArea = _BLOB_AREA_PX
    blobs = cv2.SimpleBlobDetector.create(parameters)
    segments = cv2.createLineSegmentDetector()

    def opencv_hough(picture: Picture) -> object:
        return cv2.HoughCircles(
            picture.grey, cv2.HOUGH_GRADIENT, 1, 10,
            param1=100, param2=30, minRadius=low, maxRadius=high,
        )  # fmt: skip

    def skimage_hough(picture: Picture) -> object:
        return hough_circle(canny(picture.grey, sigma=_CANNY_SIGMA_PX), radii)

    present = [
        Measured("cv2.HoughCircles", "peer", opencv_hough),
        Measured("cv2.SimpleBlobDetector", "peer", lambda p: blobs.detect(p.grey)),
        Measured("skimage hough_circle", "peer", skimage_hough),
        Measured("cv2 LSD", "peer", lambda p: segments.detect(p.grey)),
    ]
    absent = []
    extra = getattr(cv2, "ximgproc", None)
    if extra is None or not hasattr(extra, "createFastLineDetector"):
        absent.append("cv2.ximgproc FastLineDetector")
    else:
        fast = extra.createFastLineDetector()
        present.append(Measured("cv2.ximgproc FLD", "peer", lambda p: fast.detect(p.grey)))
    return present, absent


def by_picture_number(
    measured: Iterable[Measured], pictures: Sequence[Picture]
) -> dict[str, Callable[[int], object]]:
    """The functions by name, taking a picture's number instead of the picture."""

    def bound(function: Measured) -> Callable[[int], object]:
        return lambda number: function.call(pictures[number])

    return {function.name: bound(function) for function in measured}
