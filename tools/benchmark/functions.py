"""The measured functions: decoding, detectors and their parts, peers, and whole runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from camera import Camera
from detect.circles import detect_circles, disc_shape, disc_table
from detect.grey_values import estimate_noise
from detect.levelling import levelled
from detect.line_settings import DEFAULT as LINES_DEFAULT
from detect.lines import detect_lines
from detect.options import All, Circles, Lines
from detect.runs.frame import tilt_of_lines
from detect.settings import PUBLISHED, REPORT, CircleSettings
from lut import cached_disc_table, cached_vertical_table
from tools.benchmark.material import Picture
from tools.detector_maps import line_response, quality_of_centres

#: The function with which all others are compared.
DECODING = "decoding"
KERNEL, RESPONSE = "quality map (report)", "response (dense)"
CIRCLES, LINES, ALL = "circles (default)", "lines (default)", "lines, tilt and discs"

#: Radii of circles for the Hough transforms, pixels: those of the demo run's discs along u.
_HOUGH_RADII_PX = (6, 60)
_HOUGH_STEP_PX = 6

Function = Callable[[Picture], object]
Command = All | Circles | Lines


def whole_detectors(camera: Camera) -> dict[str, Function]:
    """The detectors as the commands use them, by name."""
    settings = CircleSettings()
    published = disc_table(camera, PUBLISHED)
    default = disc_table(camera, settings)
    verticals = cached_vertical_table(camera)
    return {
        "circles (published)": lambda p: detect_circles(p.grey, camera, published, PUBLISHED),
        CIRCLES: lambda p: detect_circles(p.grey, camera, default, settings),
        LINES: lambda p: detect_lines(p.grey, verticals, LINES_DEFAULT),
    }


def all_detectors(camera: Camera) -> dict[str, Function]:
    """The detectors, their parts by themselves, and most of `detect all` for one image: without
    the tilt from outlines, and the run's lean.
    """
    settings = CircleSettings()
    report = cached_disc_table(camera, disc_shape(REPORT))
    default = disc_table(camera, settings)
    verticals = cached_vertical_table(camera)

    def everything(picture: Picture) -> object:
        lines = detect_lines(picture.grey, verticals, LINES_DEFAULT)
        circles = detect_circles(picture.grey, camera, default, settings)
        tilt = tilt_of_lines("image", lines)
        return lines, circles if tilt is None else levelled(circles, camera, tilt)

    return {
        KERNEL: lambda p: quality_of_centres(p.grey, report),
        "noise estimate": lambda p: estimate_noise(p.grey),
        RESPONSE: lambda p: line_response(p.grey, verticals, LINES_DEFAULT),
        **whole_detectors(camera),
        ALL: everything,
    }


def peers() -> dict[str, Function]:
    """Detectors of circles and lines of OpenCV and scikit-image."""
    import cv2
    from skimage.feature import canny
    from skimage.transform import hough_circle

    low, high = _HOUGH_RADII_PX
    radii = np.arange(low, high + 1, _HOUGH_STEP_PX)
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.blobColor = 255
    parameters.minArea, parameters.maxArea = 30.0, 10_000.0
    blobs = cv2.SimpleBlobDetector.create(parameters)
    segments = cv2.createLineSegmentDetector()

    def opencv_hough(picture: Picture) -> object:
        return cv2.HoughCircles(
            picture.grey, cv2.HOUGH_GRADIENT, 1, 10,
            param1=100, param2=30, minRadius=low, maxRadius=high,
        )  # fmt: skip

    return {
        "cv2.HoughCircles": opencv_hough,
        "cv2.SimpleBlobDetector": lambda p: blobs.detect(p.grey),
        "skimage hough_circle": lambda p: hough_circle(canny(p.grey, sigma=2.0), radii),
        "cv2 LSD": lambda p: segments.detect(p.grey),
    }


def commands(run: Path, output: Path, jobs: int = 1) -> dict[str, Command]:
    """The commands that are measured on a run, by name; their files go into a folder."""
    circles = Circles(run=run, output=output / "discs.circles", force=True, jobs=jobs)
    published = replace(circles, output=output / "published.circles", detector=PUBLISHED)
    return {
        "detect circles --preset published": published,
        "detect circles": circles,
        "detect lines": Lines(run=run, output=output / "verticals.lines", force=True, jobs=jobs),
        "detect all": All(run=run, output=output, force=True, jobs=jobs),
    }
