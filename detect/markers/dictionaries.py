"""Dictionaries of square markers: the patterns of each set, and where their cells are.

- ``rawseeds``: RAWSEEDS deliverable D2.1 part 2. A black square of 24 units with a matrix of 6x6
  cells of 2 units, moved half a cell up and to the right, so that it lies on the right six columns
  and the upper six rows of the 7x7 grid in the square's middle. The cells are ARToolKitPlus'
  simple code.
- ``artoolkitplus12``, ``artoolkitplus8``: that code in the middle of a square of 12x12 cells
  (border of three) and of 8x8 cells (border of one).
- OpenCV's ArUco and AprilTag sets under their names in OpenCV without ``DICT_``, in small letters:
  ``4x4_50`` to ``7x7_1000``, ``aruco_original``, ``aruco_mip_36h12``, ``apriltag_16h5`` to
  ``apriltag_36h11``; border of one cell.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from cv2 import aruco
from numpy.typing import NDArray

from detect.errors import DetectError

#: ARToolKitPlus' simple code: a number of 9 bits is written four times, each time scrambled.
SIMPLE_IDS = 512
_SIMPLE_MASKS = (0x027, 0x14E, 0x109, 0x0DB)
_SIMPLE_SIDE = 6

RAWSEEDS = "rawseeds"
ARTOOLKITPLUS_12 = "artoolkitplus12"
ARTOOLKITPLUS_8 = "artoolkitplus8"

_OPENCV_PREFIX = "DICT_"


@dataclass(frozen=True, eq=False)
class MarkerDictionary:
    """A set of markers.

    Attributes
    ----------
    name : str
        As in `dictionary_names`.
    ids : (N,) int64
        The markers' numbers.
    patterns : (N, G, G) bool
        The cells of the sampled grid, True for white; row 0 is the marker's top.
    centres : (G,) float64
        Where the grid's columns (and rows) have their centres, in widths of the marker from its
        left (upper) edge.
    cell : float
        Width of a cell, in widths of the marker.
    """

    name: str
    ids: NDArray[np.int64]
    patterns: NDArray[np.bool_]
    centres: NDArray[np.float64]
    cell: float

    def __len__(self) -> int:
        return len(self.ids)

    def only(self, ids: tuple[int, ...]) -> MarkerDictionary:
        """The same dictionary with the given markers alone.

        Raises
        ------
        DetectError
            If it has no marker of such a number.
        """
        wanted = np.unique(np.array(ids, dtype=np.int64))
        missing = np.setdiff1d(wanted, self.ids)
        if len(missing):
            raise DetectError(
                f"marker {missing[0]}: not in {self.name}, whose IDs are "
                f"{self.ids.min()} to {self.ids.max()}"
            )
        index = np.searchsorted(self.ids, wanted)
        return MarkerDictionary(
            self.name, self.ids[index], self.patterns[index], self.centres, self.cell
        )


def dictionary_names() -> tuple[str, ...]:
    """Names that `marker_dictionary` accepts."""
    return (RAWSEEDS, ARTOOLKITPLUS_12, ARTOOLKITPLUS_8, *sorted(_opencv_constants()))


@functools.cache
def marker_dictionary(name: str) -> MarkerDictionary:
    """A set of markers by its name.

    Parameters
    ----------
    name : str
        One of `dictionary_names`.

    Returns
    -------
    MarkerDictionary

    Raises
    ------
    DetectError
        If there is none of that name.
    """
    if name == RAWSEEDS:
        patterns = np.zeros((SIMPLE_IDS, 7, 7), bool)
        patterns[:, :6, 1:] = simple_patterns()
        return _dictionary(name, patterns, cells=12, first=2.5)
    if name == ARTOOLKITPLUS_12:
        return _dictionary(name, _framed(simple_patterns()), cells=12, first=2.0)
    if name == ARTOOLKITPLUS_8:
        return _dictionary(name, _framed(simple_patterns()), cells=8, first=0.0)
    constant = _opencv_constants().get(name)
    if constant is None:
        raise DetectError(
            f"{name!r:.60}: no such dictionary of markers: expected one of "
            f"{', '.join(dictionary_names())}"
        )
    patterns = _opencv_patterns(constant)
    return _dictionary(name, patterns, cells=patterns.shape[-1], first=0.0)


def simple_patterns() -> NDArray[np.bool_]:
    """(512, 6, 6) cells of ARToolKitPlus' simple code by number, True for white."""
    ids = np.arange(SIMPLE_IDS, dtype=np.int64)
    code = np.zeros_like(ids)
    for copy, mask in enumerate(_SIMPLE_MASKS):
        code |= (ids ^ mask) << (9 * copy)
    shifts = np.arange(_SIMPLE_SIDE**2 - 1, -1, -1)
    bits = (code[:, None] >> shifts) & 1
    return np.asarray(bits.reshape(-1, _SIMPLE_SIDE, _SIMPLE_SIDE).astype(bool))


def _dictionary(
    name: str, patterns: NDArray[np.bool_], *, cells: int, first: float
) -> MarkerDictionary:
    """A dictionary whose sampled grid begins `first` cells from the edge of a marker of `cells`."""
    side = patterns.shape[-1]
    return MarkerDictionary(
        name=name,
        ids=np.arange(len(patterns), dtype=np.int64),
        patterns=patterns,
        centres=(first + 0.5 + np.arange(side)) / cells,
        cell=1.0 / cells,
    )


def _framed(patterns: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Patterns with one ring of the black border round them."""
    return np.pad(patterns, ((0, 0), (1, 1), (1, 1)))


@functools.cache
def _opencv_constants() -> dict[str, int]:
    names = (name for name in dir(aruco) if name.startswith(_OPENCV_PREFIX))
    return {name.removeprefix(_OPENCV_PREFIX).lower(): getattr(aruco, name) for name in names}


def _opencv_patterns(constant: int) -> NDArray[np.bool_]:
    """Patterns of an OpenCV dictionary, with the border of one cell."""
    dictionary = aruco.getPredefinedDictionary(constant)
    side = dictionary.markerSize + 2
    return np.stack(
        [
            aruco.generateImageMarker(dictionary, number, side, borderBits=1) > 127
            for number in range(len(dictionary.bytesList))
        ]
    )
