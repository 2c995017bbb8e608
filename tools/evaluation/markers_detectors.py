"""Detectors of square markers as functions of one kind: this project's, and OpenCV's ArUco."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from camera import Camera

OURS = "redetect"

#: OpenCV's refinements of corners, by the names under which they are shown, and what is taken off
#: their corners: the AprilTag code puts (0, 0) at the upper left pixel's corner, not at its centre.
_REFINEMENTS = {
    "aruco": ("CORNER_REFINE_NONE", 0.0),
    "aruco subpix": ("CORNER_REFINE_SUBPIX", 0.0),
    "aruco contour": ("CORNER_REFINE_CONTOUR", 0.0),
    "aruco apriltag": ("CORNER_REFINE_APRILTAG", 0.0),
    "apriltag - 0.5": ("CORNER_REFINE_APRILTAG", 0.5),
}
PEERS = tuple(_REFINEMENTS)


@dataclass(frozen=True, eq=False)
class Found:
    """Markers that a detector found in an image.

    Attributes
    ----------
    ids : (N,) int64
    corners : (N, 4, 2) float64
        Top left, top right, bottom right, bottom left as printed; pixels of the image as it is.
    covariances : (N, 4, 2, 2) float64 or None
        Of the corners, if the detector says.
    """

    ids: NDArray[np.int64]
    corners: NDArray[np.float64]
    covariances: NDArray[np.float64] | None = None


Detector = Callable[[NDArray[np.uint8], Camera | None, str], Found]


def detector_of(name: str) -> Detector:
    """A detector: a function of image, calibration and the dictionary's name.

    Parameters
    ----------
    name : str
        ``redetect`` or one of `PEERS`.

    Raises
    ------
    ValueError
        If there is none of that name.
    """
    if name == OURS:
        return _ours
    if name in _REFINEMENTS:
        return lambda image, camera, dictionary: _aruco(name, image, dictionary)
    raise ValueError(f"{name}: no such detector: expected {OURS} or one of {', '.join(PEERS)}")


def known_to_opencv(dictionary: str) -> bool:
    """Whether OpenCV has a dictionary of that name."""
    return dictionary in _opencv_dictionaries()


def _ours(image: NDArray[np.uint8], camera: Camera | None, dictionary: str) -> Found:
    from detect.markers.detect import detect_markers
    from detect.markers.settings import MarkerSettings

    found = detect_markers(image, MarkerSettings(dictionary=dictionary), camera)
    return Found(found.ids, found.corners, found.covariance)


def _aruco(name: str, image: NDArray[np.uint8], dictionary: str) -> Found:
    corners, ids, _ = _aruco_detector(name, dictionary).detectMarkers(image)
    if ids is None:
        return Found(np.zeros(0, np.int64), np.zeros((0, 4, 2)))
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2) - _REFINEMENTS[name][1]
    return Found(np.asarray(ids, dtype=np.int64).ravel(), pixels)


@cache
def _aruco_detector(name: str, dictionary: str):  # type: ignore[no-untyped-def]
    from cv2 import aruco

    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = getattr(aruco, _REFINEMENTS[name][0])
    known = aruco.getPredefinedDictionary(_opencv_dictionaries()[dictionary])
    return aruco.ArucoDetector(known, parameters)


@cache
def _opencv_dictionaries() -> dict[str, int]:
    from cv2 import aruco

    names = [name for name in dir(aruco) if name.startswith("DICT_")]
    return {name.removeprefix("DICT_").lower(): getattr(aruco, name) for name in names}
