"""Dictionaries of square markers: the patterns of each set, the layout of cells, and templates.

- ``rawseeds``: RAWSEEDS deliverable D2.1 part 2. A black square of 24 units with a matrix of 6x6
  cells of 2 units, shifted half a cell up and to the right, so that it occupies the right six
  columns and the upper six rows of the 7x7 grid in the square's middle. The cells are
  ARToolKitPlus' simple code.
- ``artoolkitplus12``, ``artoolkitplus8``: that code in the middle of a square of 12x12 cells
  (border of three) and of 8x8 cells (border of one).
- OpenCV's ArUco and AprilTag sets by their names in OpenCV without ``DICT_``, in lower case:
  ``4x4_50`` to ``7x7_1000``, ``aruco_original``, ``aruco_mip_36h12``, ``apriltag_16h5`` to
  ``apriltag_36h11``; border of one cell.

Templates are the patterns prepared for comparison: in four rotations, blurred, and as geometry.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
from cv2 import aruco
from numpy.lib.stride_tricks import sliding_window_view

from detect.errors import DetectError
from redetect.array_types import BoolArray, Float32Array, FloatArray, IntArray
from redetect.messages import no_such

#: ARToolKitPlus' simple code: a number of 9 bits is stored four times, each time scrambled.
_SIMPLE_BITS, _SIMPLE_SIDE = 9, 6
_SIMPLE_MASKS = (0x027, 0x14E, 0x109, 0x0DB)
_OPENCV_PREFIX = "DICT_"

#: A random pattern is in the dictionary with probability 2 to the power of minus this: for strong
#: dictionaries, and for weak ones.
_STRONG_BITS, _WEAK_BITS = 24.0, 14.0
#: Blurs for which templates are kept, in cells.
_BLURS_CELLS = (0.2, 0.35, 0.5, 0.7, 1.0)


@dataclass(frozen=True, eq=False)
class MarkerDictionary:
    """A set of markers; its name is one of `dictionary_names`."""

    name: str
    ids: IntArray  # (N,)
    patterns: BoolArray  # (N, G, G) cells, True for white; row 0 is the marker's top
    centres: FloatArray  # (G,) centres of columns and rows, in widths of the marker
    cell: float  # width of a cell, in widths of the marker

    def __len__(self) -> int:
        return len(self.ids)

    def only(self, ids: tuple[int, ...]) -> MarkerDictionary:
        """The same dictionary with only the given markers; a DetectError if it lacks one."""
        wanted = np.unique(np.array(ids, dtype=np.int64))
        missing = np.setdiff1d(wanted, self.ids)
        if len(missing):
            raise DetectError(
                f"marker {missing[0]}: not in {self.name}, whose IDs are "
                f"{self.ids.min()} to {self.ids.max()}"
            )
        index = np.searchsorted(self.ids, wanted)
        return replace(self, ids=self.ids[index], patterns=self.patterns[index])


def dictionary_names() -> tuple[str, ...]:
    """Names that `marker_dictionary` accepts."""
    return ("rawseeds", "artoolkitplus12", "artoolkitplus8", *sorted(_opencv_constants()))


@functools.cache
def marker_dictionary(name: str) -> MarkerDictionary:
    """A set of markers by its name, one of `dictionary_names`; else a DetectError.

    Other programs' names are accepted, too: DICT_4X4_50, tag36h11, 36h11.
    """
    given, plain = name, name.lower().removeprefix("dict_").removeprefix("tag")
    listed = dictionary_names()
    name = next((each for each in (plain, f"apriltag_{plain}") if each in listed), "")
    if not name:
        raise DetectError(no_such("no such dictionary of markers:", given, listed))
    # Width of a marker in cells, and the number of cells before the sampled grid.
    if name == "rawseeds":
        patterns, cells, first = np.pad(simple_patterns(), ((0, 0), (0, 1), (1, 0))), 12, 2.5
    elif name == "artoolkitplus12":
        patterns, cells, first = np.pad(simple_patterns(), ((0, 0), (1, 1), (1, 1))), 12, 2.0
    elif name == "artoolkitplus8":
        patterns, cells, first = np.pad(simple_patterns(), ((0, 0), (1, 1), (1, 1))), 8, 0.0
    else:
        known = aruco.getPredefinedDictionary(_opencv_constants()[name])
        cells, first, numbers = known.markerSize + 2, 0.0, range(len(known.bytesList))
        drawn = [aruco.generateImageMarker(known, number, cells) for number in numbers]
        patterns = np.stack(drawn) > 127
    centres = (first + 0.5 + np.arange(patterns.shape[-1])) / cells
    return MarkerDictionary(name, np.arange(len(patterns)), patterns, centres, 1.0 / cells)


def simple_patterns() -> BoolArray:
    """(512, 6, 6) cells of ARToolKitPlus' simple code by number, True for white."""
    ids = np.arange(1 << _SIMPLE_BITS)
    copies = [(ids ^ mask) << (_SIMPLE_BITS * k) for k, mask in enumerate(_SIMPLE_MASKS)]
    code = np.bitwise_or.reduce(copies)
    bits = (code[:, None] >> np.arange(_SIMPLE_SIDE**2)[::-1]) & 1
    return np.asarray(bits.reshape(-1, _SIMPLE_SIDE, _SIMPLE_SIDE), bool)


@functools.cache
def _opencv_constants() -> dict[str, int]:
    names = (name for name in dir(aruco) if name.startswith(_OPENCV_PREFIX))
    return {name.removeprefix(_OPENCV_PREFIX).lower(): getattr(aruco, name) for name in names}


@dataclass(frozen=True, eq=False)
class Templates:
    """Templates of the expected markers' cells, each marker rotated by 0, 90, 180, 270 deg."""

    dictionary: MarkerDictionary
    cells: Float32Array  # (T, G * G) 1 for white; all markers, then all rotated once ...
    blurred: tuple[Float32Array, ...]  # for each blur, with mean 0 and norm 1
    weakness: float  # likelihood of patterns by chance, from 0 (hardly ever) to 1
    decoys: Float32Array  # (D, G * G) content of other frames: nothing, a bar, or a half
    plain: BoolArray  # (T,) mask of templates that are similar to decoys
    lines: FloatArray  # (L,) boundaries of cells and of the square, in its widths from 0 to 1
    grid: slice  # rows, and columns, of the grid among the cells between the lines
    border: float  # least thickness of the black border in widths of the marker

    def turned_id(self, template: int) -> tuple[int, int]:
        """ID of a template's marker, and its quarter turns anti-clockwise."""
        turns, marker = divmod(template, len(self.dictionary))
        return int(self.dictionary.ids[marker]), turns

    def blackness(self, template: int) -> FloatArray:
        """(L - 1, L - 1) pattern of a template between the lines, 1 for black."""
        side = self.dictionary.patterns.shape[-1]
        result = np.ones((len(self.lines) - 1,) * 2)
        result[self.grid, self.grid] = 1.0 - self.cells[template].reshape(side, side)
        return result

    def nearest_blur(self, blur_cells: float) -> Float32Array:
        """The blurred templates whose blur is nearest to the given one."""
        ratio = np.log(np.array(_BLURS_CELLS) / max(blur_cells, 1e-3))
        return self.blurred[int(np.argmin(np.abs(ratio)))]


@functools.lru_cache(maxsize=16)
def templates_of(name: str, ids: tuple[int, ...]) -> Templates:
    """Templates of a dictionary's markers: of the given IDs, or of all if there are none.

    Raises DetectError if there is no such dictionary or marker.
    """
    dictionary = marker_dictionary(name)
    if ids:
        dictionary = dictionary.only(ids)
    side = dictionary.patterns.shape[-1]
    turned = [np.rot90(dictionary.patterns, turn, axes=(1, 2)) for turn in range(4)]
    patterns = np.concatenate(turned).astype(np.float32)
    begin = dictionary.centres[0] - 0.5 * dictionary.cell
    edges = begin + dictionary.cell * np.arange(side + 1)
    inner = edges[(edges > 1e-9) & (edges < 1.0 - 1e-9)]
    lines = np.concatenate([[0.0], inner, [1.0]])
    first = 0 if begin < 1e-9 else 1
    # Outermost ring of the grid with a white cell in some marker.
    varied = np.asarray(dictionary.patterns.any(axis=0))
    used = np.asarray(varied.any(axis=0) | varied.any(axis=1))
    ring = int(np.argmax(used | used[::-1]))
    bits = int(varied.sum()) - np.log2(len(patterns))
    decoys, plain = _decoys(varied, patterns)
    return Templates(
        dictionary=dictionary,
        cells=patterns.reshape(len(patterns), -1),
        blurred=tuple(_blurred(patterns, blur, float(first == 0)) for blur in _BLURS_CELLS),
        weakness=float(np.clip((_STRONG_BITS - bits) / (_STRONG_BITS - _WEAK_BITS), 0.0, 1.0)),
        decoys=decoys,
        plain=plain,
        lines=lines,
        grid=slice(first, first + side),
        border=float(edges[ring]),
    )


def _blurred(patterns: Float32Array, blur_cells: float, around: float) -> Float32Array:
    """Grey values at the centres of blurred cells, with mean 0 and norm 1."""
    cdf = [NormalDist(0.0, blur_cells).cdf(end - 0.5) for end in range(-2, 4)]
    shares = (np.diff(cdf) / (cdf[-1] - cdf[0])).astype(np.float32)
    padded = np.pad(patterns, ((0, 0), (2, 2), (2, 2)), constant_values=around)
    # Not by `@`, whose vector instructions may flag values beyond the end of a window as invalid.
    windows = sliding_window_view(padded, (5, 5), axis=(1, 2))
    grey = np.einsum("nijkl,k,l->nij", windows, shares, shares)
    flat = grey.reshape(len(grey), -1)
    flat = flat - flat.mean(axis=1, keepdims=True)
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    return np.asarray(flat / np.maximum(length, 1e-6), np.float32)


def _decoys(varied: BoolArray, patterns: Float32Array) -> tuple[Float32Array, BoolArray]:
    """Patterns of frames, bars and panes, and a mask of the markers less than two cells from one.

    Decoys that near a marker's pattern are omitted, since it could never be found.
    """
    rows, columns = np.flatnonzero(varied.any(axis=1)), np.flatnonzero(varied.any(axis=0))
    j, i = np.indices((len(rows), len(columns)))
    inner = [np.zeros(i.shape, bool)]
    for place in (i, j):
        for begin, end in itertools.combinations(range(place.max() + 2), 2):
            inner.append((place >= begin) & (place < end))
    for thick in range(1, max(2, len(columns) // 2)):
        for shift in range(thick):
            column, row = (i + shift) // thick % 2 == 0, (j + shift) // thick % 2 == 0
            inner += [column, row, column ^ row, column | row, column & row]
    decoys = np.zeros((2 * len(inner), *varied.shape), np.float32)
    inside = np.s_[rows[0] : rows[0] + len(rows), columns[0] : columns[0] + len(columns)]
    decoys[:, *inside] = inner + [~pattern for pattern in inner]
    flat = np.unique(decoys.reshape(len(decoys), -1), axis=0)
    known = patterns.reshape(len(patterns), -1)
    apart = flat.sum(axis=1)[:, None] + known.sum(axis=1)[None] - 2.0 * flat @ known.T
    near = apart < 2.0
    return flat[~near.any(axis=1)], near.any(axis=0)
