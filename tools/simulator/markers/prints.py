"""What is printed: markers with their quiet zone, and near misses that are in no dictionary."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detect.markers.dictionaries import MarkerDictionary
from tools.simulator.markers.surface import FloatArray, Surface, Texture

#: Reflectance of printer's black and of paper.
BLACK, WHITE = 0.05, 0.88

#: What differs in fewer cells from a marker could rightly be taken for it.
LEAST_DIFFERENCE = 3
_TRIES = 64

# Points along a cell by which a texture is looked at, and again for what is between them.
_FINE = 4


def marker_texture(
    dictionary: MarkerDictionary,
    marker_id: int,
    *,
    quiet_cells: int = 1,
    black: float = BLACK,
    white: float = WHITE,
) -> Texture:
    """A marker as it is printed, on a white card.

    Parameters
    ----------
    dictionary : MarkerDictionary
        The set it is from.
    marker_id : int
        Its number.
    quiet_cells : int
        Width of the white rim in cells.
    black, white : float
        Reflectances.

    Returns
    -------
    Texture

    Raises
    ------
    ValueError
        If the dictionary has no such marker.
    """
    where = np.flatnonzero(dictionary.ids == marker_id)
    if len(where) == 0:
        raise ValueError(f"marker {marker_id}: not in {dictionary.name}")
    return pattern_texture(dictionary, dictionary.patterns[where[0]], quiet_cells, black, white)


def pattern_texture(
    dictionary: MarkerDictionary,
    pattern: NDArray[np.bool_],
    quiet_cells: int = 1,
    black: float = BLACK,
    white: float = WHITE,
) -> Texture:
    """Any pattern laid out as the dictionary's markers are; parameters as in `marker_texture`."""
    cells = round(1.0 / dictionary.cell)
    first = dictionary.centres[0] * cells - 0.5
    # The cells of RAWSEEDS lie half a cell off the others' grid.
    per_cell = 1 if abs(first - round(first)) < 1e-9 else 2
    quiet = quiet_cells * per_cell
    side = cells * per_cell + 2 * quiet
    values = np.full((side, side), white, dtype=np.float32)
    values[quiet : side - quiet, quiet : side - quiet] = black
    begin = quiet + round(first * per_cell)
    inner = np.repeat(np.repeat(pattern, per_cell, axis=0), per_cell, axis=1)
    end = begin + len(inner)
    values[begin:end, begin:end][inner] = white
    return Texture(values)


def marker_surface(
    dictionary: MarkerDictionary,
    marker_id: int,
    width_m: float,
    pose: FloatArray,
    *,
    quiet_cells: int = 1,
    black: float = BLACK,
    white: float = WHITE,
    back: float = 0.3,
) -> Surface:
    """A marker whose black square is `width_m` wide, as a card in space.

    Parameters
    ----------
    dictionary, marker_id, quiet_cells, black, white
        As in `marker_texture`.
    width_m : float
        Width of the black square.
    pose : (4, 4) array
        parent_from_marker.
    back : float
        Reflectance of the card's back; NaN where it cannot be seen.
    """
    texture = marker_texture(
        dictionary, marker_id, quiet_cells=quiet_cells, black=black, white=white
    )
    card_m = width_m * (1.0 + 2.0 * quiet_cells * dictionary.cell)
    return Surface(pose, card_m, card_m, texture, back)


def pattern_distance(dictionary: MarkerDictionary, pattern: NDArray[np.bool_]) -> int:
    """In how many cells a pattern differs, in any of its four rotations, from the nearest marker.

    Parameters
    ----------
    dictionary : MarkerDictionary
        The set.
    pattern : (G, G) bool
        The sampled grid.
    """
    known = dictionary.patterns.reshape(len(dictionary), -1)
    turned = np.stack([np.rot90(pattern, k).ravel() for k in range(4)])
    return int(min(np.count_nonzero(known != t, axis=1).min() for t in turned))


def texture_distance(dictionary: MarkerDictionary, texture: Texture) -> float:
    """In how many cells a dark thing on a light ground differs from the nearest marker.

    Parameters
    ----------
    dictionary : MarkerDictionary
        The set.
    texture : Texture
        The thing with its light rim, if it has one.

    Returns
    -------
    float
        Sum over the sampled grid of the difference in whiteness, each cell taken as a whole;
        infinite for smooth textures and those that are all light.
    """
    import cv2

    dark = texture.values < 0.5 * (BLACK + WHITE)
    if texture.smooth or not dark.any():
        return float("inf")
    rows, columns = np.flatnonzero(dark.any(axis=1)), np.flatnonzero(dark.any(axis=0))
    square = ~dark[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    units = round(1.0 / dictionary.cell) * _FINE
    fine = cv2.resize(
        square.astype(np.float32), (units * _FINE, units * _FINE), interpolation=cv2.INTER_NEAREST
    )
    half = 0.5 * dictionary.cell
    limits = np.rint((dictionary.centres[:, None] + [-half, half]) * len(fine)).astype(int)
    cells = np.array([[fine[a:b, c:d].mean() for c, d in limits] for a, b in limits])
    known = dictionary.patterns.reshape(len(dictionary), -1)
    turned = (np.rot90(cells, k).ravel() for k in range(4))
    return float(min(np.abs(known - t).sum(axis=1).min() for t in turned))


def near_pattern(
    dictionary: MarkerDictionary, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], int]:
    """A pattern laid out as the dictionary's, but of no marker in it.

    Half of the patterns are random, half are markers some of whose cells were changed.

    Parameters
    ----------
    dictionary : MarkerDictionary
        The set that it must not be in.
    rng : numpy Generator
        Source of chance.

    Returns
    -------
    pattern : (G, G) bool
    distance : int
        In how many cells it differs from the nearest marker. At least 3, unless none of 64 patterns
        tried differs by so many (a dictionary that all but fills its space): then the most
        different of them.
    """
    used = dictionary.patterns.any(axis=0)
    changed = rng.random() < 0.5
    best: tuple[NDArray[np.bool_], int] | None = None
    for _ in range(_TRIES):
        if changed:
            pattern = dictionary.patterns[rng.integers(len(dictionary))].copy()
            cells = np.argwhere(used)
            chosen = rng.choice(len(cells), rng.integers(3, 9), replace=False)
            pattern[tuple(cells[chosen].T)] ^= True
        else:
            pattern = (rng.random(used.shape) < rng.uniform(0.3, 0.7)) & used
        distance = pattern_distance(dictionary, pattern)
        if best is None or distance > best[1]:
            best = pattern, distance
        if distance >= LEAST_DIFFERENCE:
            break
    if best is None:
        raise RuntimeError("no pattern was tried")
    return best
