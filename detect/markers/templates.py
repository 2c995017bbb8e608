"""A dictionary's patterns made ready for comparison: turned four ways, blurred, and as geometry."""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.markers.dictionaries import MarkerDictionary, marker_dictionary
from detect.markers.settings import MarkerSettings

FloatArray = NDArray[np.float64]

#: A random pattern is one of the dictionary's with a probability of 2 to the power of minus this:
#: in strong dictionaries, and in weak ones.
_STRONG_BITS, _WEAK_BITS = 24.0, 14.0

#: Size of the cells and the margin of a specimen.
_CELL_PX, _MARGIN_PX = 5, 20

#: Blurs for which templates are kept, in cells.
_BLURS_CELLS = (0.2, 0.35, 0.5, 0.7, 1.0)


@dataclass(frozen=True, eq=False)
class Templates:
    """Templates of the expected markers' cells, for each marker turned by 0, 90, 180, 270 deg.

    Attributes
    ----------
    dictionary : MarkerDictionary
        The markers.
    cells : (T, G * G) float32
        1 for white; T is four times the number of markers.
    weakness : float
        How likely a pattern occurs by chance, from 0 (hardly ever) to 1.
    decoys : (D, G * G) float32
        Content of other black frames: nothing, a bar, or a half.
    plain : (T,) bool
        Which of the templates are similar to these.
    marker : (T,) int64
        Index of the marker in the dictionary.
    turns : (T,) int64
        Quarter turns anti-clockwise: its top left corner is the candidate's corner -`turns`.
    blurred : tuple of (T, G * G) float32
        The cells less their mean and of length 1, for each blur of `blurs`.
    blurs : tuple of float
        Standard deviations, cells.
    lines : (L,) float64
        Where cells end, from 0 to 1, in widths of the marker: those of the grid and the square's
        own edges.
    first : int
        Index of the grid's first cell among those between the lines.
    border : float
        Least thickness of the black border in widths of the marker.
    """

    dictionary: MarkerDictionary
    cells: NDArray[np.float32]
    weakness: float
    decoys: NDArray[np.float32]
    plain: NDArray[np.bool_]
    marker: NDArray[np.int64]
    turns: NDArray[np.int64]
    blurred: tuple[NDArray[np.float32], ...]
    blurs: tuple[float, ...]
    lines: FloatArray
    first: int
    border: float

    @property
    def grid(self) -> slice:
        """Rows, and columns, of the grid among the cells between the lines."""
        return slice(self.first, self.first + self.dictionary.patterns.shape[-1])

    def blackness(self, template: int) -> FloatArray:
        """(L - 1, L - 1) pattern of a template between the lines, 1 for black."""
        side = self.dictionary.patterns.shape[-1]
        result = np.ones((len(self.lines) - 1,) * 2)
        result[self.grid, self.grid] = 1.0 - self.cells[template].reshape(side, side)
        return result

    def nearest_blur(self, blur_cells: float) -> NDArray[np.float32]:
        """The normalised templates of the blur next to the given one."""
        index = int(np.argmin([abs(np.log(blur / max(blur_cells, 1e-3))) for blur in self.blurs]))
        return self.blurred[index]


@functools.lru_cache(maxsize=16)
def templates_of(name: str, ids: tuple[int, ...]) -> Templates:
    """Templates of a dictionary's markers.

    Parameters
    ----------
    name : str
        The dictionary.
    ids : tuple of int
        The markers expected; none for all.

    Returns
    -------
    Templates

    Raises
    ------
    DetectError
        If there is no such dictionary or marker.
    """
    dictionary = marker_dictionary(name)
    if ids:
        dictionary = dictionary.only(ids)
    count, side = len(dictionary), dictionary.patterns.shape[-1]
    turned = [np.rot90(dictionary.patterns, turn, axes=(1, 2)) for turn in range(4)]
    patterns = np.concatenate(turned).astype(np.float32)
    decoys, plain = _decoys(dictionary, patterns)
    step = dictionary.cell
    edges = dictionary.centres[0] - 0.5 * step + step * np.arange(side + 1)
    inner = edges[(edges > 1e-9) & (edges < 1.0 - 1e-9)]
    lines = np.concatenate([[0.0], inner, [1.0]])
    return Templates(
        dictionary=dictionary,
        cells=np.ascontiguousarray(patterns.reshape(len(patterns), -1)),
        weakness=_weakness(dictionary, len(patterns)),
        decoys=decoys,
        plain=plain,
        marker=np.tile(np.arange(count, dtype=np.int64), 4),
        turns=np.repeat(np.arange(4, dtype=np.int64), count),
        blurred=tuple(
            _normalised(_blurred(patterns, blur, touches_edge=edges[0] < 1e-9))
            for blur in _BLURS_CELLS
        ),
        blurs=_BLURS_CELLS,
        lines=np.ascontiguousarray(lines),
        first=0 if edges[0] < 1e-9 else 1,
        border=_border(dictionary, float(edges[0])),
    )


def _blurred(
    patterns: NDArray[np.float32], blur_cells: float, *, touches_edge: bool
) -> NDArray[np.float32]:
    """Grey value in the middle of each cell under a Gaussian blur; white round the marker."""
    from scipy.special import ndtr

    around = 1.0 if touches_edge else 0.0
    padded = np.pad(patterns, ((0, 0), (2, 2), (2, 2)), constant_values=around)
    ends = (np.arange(-2, 4) - 0.5) / blur_cells
    # Shares of the five cells round the middle.
    shares = np.diff(ndtr(ends))
    shares /= shares.sum()
    side = patterns.shape[-1]
    rows = sum(share * padded[:, k : k + side, :] for k, share in enumerate(shares))
    return np.asarray(
        sum(share * rows[:, :, k : k + side] for k, share in enumerate(shares)), np.float32
    )


def _normalised(patterns: NDArray[np.float32]) -> NDArray[np.float32]:
    flat = patterns.reshape(len(patterns), -1)
    centred = flat - flat.mean(axis=1, keepdims=True)
    length = np.linalg.norm(centred, axis=1, keepdims=True)
    return np.ascontiguousarray(centred / np.maximum(length, 1e-6), dtype=np.float32)


def _weakness(dictionary: MarkerDictionary, templates: int) -> float:
    bits = int(dictionary.patterns.any(axis=0).sum()) - np.log2(templates)
    return float(np.clip((_STRONG_BITS - bits) / (_STRONG_BITS - _WEAK_BITS), 0.0, 1.0))


def _decoys(
    dictionary: MarkerDictionary, patterns: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Patterns of frames, bars, panes, and which of the markers' are within two cells of them.

    Decoys that are as near a marker's pattern are left out: it could never be found.
    """
    varied = np.asarray(dictionary.patterns.any(axis=0))
    rows, columns = np.flatnonzero(varied.any(axis=1)), np.flatnonzero(varied.any(axis=0))
    top, left, height, width = rows[0], columns[0], len(rows), len(columns)
    j, i = np.indices((height, width))
    inner = [np.zeros((height, width), bool), np.ones((height, width), bool)]
    for place, count in ((i, width), (j, height)):
        for begin, end in itertools.combinations(range(count + 1), 2):
            bar = (place >= begin) & (place < end)
            inner += [bar, ~bar]
    for thick in range(1, max(2, width // 2)):
        for shift in range(thick):
            column, row = (i + shift) // thick % 2 == 0, (j + shift) // thick % 2 == 0
            inner += [column, ~column, row, ~row, column ^ row, column == row]
            inner += [column | row, column & row, ~(column | row), ~(column & row)]
    side = dictionary.patterns.shape[-1]
    decoys = np.zeros((len(inner), side, side), np.float32)
    for k, pattern in enumerate(inner):
        decoys[k, top : top + height, left : left + width] = pattern
    flat = np.unique(decoys.reshape(len(decoys), -1), axis=0)
    known = patterns.reshape(len(patterns), -1)
    apart = flat.sum(axis=1)[:, None] + known.sum(axis=1)[None] - 2.0 * flat @ known.T
    near = apart < 2.0
    return np.ascontiguousarray(flat[~near.any(axis=1)]), near.any(axis=0)


def _border(dictionary: MarkerDictionary, first_edge: float) -> float:
    """Rings of the grid that are black in all markers, and what is outside the grid."""
    white = np.asarray(dictionary.patterns.any(axis=0))
    rings = 0
    while rings < white.shape[0] // 2 and not (
        white[rings].any() or white[-1 - rings].any()
        or white[:, rings].any() or white[:, -1 - rings].any()
    ):  # fmt: skip
        rings += 1
    return first_edge + rings * dictionary.cell


def specimen_image(settings: MarkerSettings) -> NDArray[np.uint8]:
    """A grey image of one of the expected markers on white, seen from the front."""
    templates = templates_of(settings.dictionary, settings.ids)
    widths = np.diff(templates.lines) / templates.dictionary.cell
    pixels = np.maximum(1, np.rint(widths * _CELL_PX)).astype(np.intp)
    black = np.repeat(np.repeat(templates.blackness(0), pixels, axis=0), pixels, axis=1)
    grey = np.where(np.pad(black, _MARGIN_PX) > 0.5, 40.0, 200.0)
    # Soft edges, as all images have them.
    return np.asarray(np.rint(cv2.blur(grey, (3, 3))), np.uint8)
