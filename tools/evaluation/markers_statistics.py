"""Statistics of detected markers by width, slant, blur and contrast, detectors side by side."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.evaluation.markers_detectors import OURS
from tools.evaluation.markers_scoring import FOUND, MISIDENTIFIED, Table

#: Limits of the bins of each quantity.
BINS: dict[str, tuple[float, ...]] = {
    "width_px": (12, 16, 20, 28, 40, 60, 90, 130, 200),
    "slant_deg": (0, 15, 30, 45, 60, 70),
    "blur_px": (0.3, 0.5, 0.8, 1.3, 2.0, 3.0),
    "contrast_grey": (10, 20, 35, 60, 100, 200),
}
TITLES = {
    "width_px": "width / px",
    "slant_deg": "slant / deg",
    "blur_px": "blur / px",
    "contrast_grey": "contrast / grey levels",
}

# A bin in which fewer markers were found says nothing of their errors.
_FEWEST = 5


@dataclass(frozen=True)
class Figures:
    """What a detector did with the clear markers of a bin."""

    markers: int
    """Clear markers in the bin."""
    found: int
    misidentified: int
    median_px: float
    """Median distance of corners from the truth; NaN where fewer than 5 markers were found."""
    rms_px: float
    q95_px: float
    normalised: float
    """Mean squared error over the covariance per degree of freedom; NaN without covariances."""

    @property
    def rate(self) -> float:
        """Share of the markers that were found."""
        return self.found / self.markers if self.markers else float("nan")


@dataclass(frozen=True)
class Bin:
    """Figures of all detectors over the markers of one range of a quantity.

    Attributes
    ----------
    quantity : str
        What the range is of; empty for all markers together.
    low, high : float
    own : dict of detector to Figures
        Errors over all markers that this detector found.
    shared : dict of peer to (ours, peer's) Figures
        Errors over the markers that both found: like with like.
    """

    quantity: str
    low: float
    high: float
    own: dict[str, Figures]
    shared: dict[str, tuple[Figures, Figures]]

    @property
    def ahead_in_error(self) -> bool | None:
        """Whether our median error is below every peer's on the shared markers.

        None where there are too few.
        """
        pairs = [p for p in self.shared.values() if np.isfinite(p[1].median_px)]
        if not pairs:
            return None
        return all(ours.median_px < peer.median_px for ours, peer in pairs)

    @property
    def ahead_in_rate(self) -> bool:
        """Whether we find at least as many markers as every peer."""
        return all(f.found <= self.own[OURS].found for f in self.own.values())


def binned(table: Table, chosen: NDArray[np.bool_] | None = None) -> list[Bin]:
    """Figures of all markers that are clearly in view, and by bins of each quantity.

    Parameters
    ----------
    table : Table
        Markers and what became of them.
    chosen : (M,) bool, optional
        Which markers to look at.

    Returns
    -------
    list of Bin
        First all together.
    """
    clear = table.columns["clear"] > 0.0
    if chosen is not None:
        clear = clear & chosen
    bins = [_bin(table, clear, "", 0.0, float("inf"))]
    for quantity, limits in BINS.items():
        values = table.columns[quantity]
        for low, high in itertools.pairwise(limits):
            last = high == limits[-1]
            inside = (values >= low) & ((values <= high) if last else (values < high))
            bins.append(_bin(table, clear & inside, quantity, low, high))
    return bins


def _bin(table: Table, inside: NDArray[np.bool_], quantity: str, low: float, high: float) -> Bin:
    own = {name: _figures(table, name, inside, inside) for name in table.status}
    shared = {}
    for name in table.status:
        if name != OURS and OURS in table.status:
            both = inside & (table.status[OURS] == FOUND) & (table.status[name] == FOUND)
            shared[name] = (
                _figures(table, OURS, inside, both),
                _figures(table, name, inside, both),
            )
    return Bin(quantity, low, high, own, shared)


def _figures(
    table: Table, name: str, inside: NDArray[np.bool_], judged: NDArray[np.bool_]
) -> Figures:
    """Counts over the markers inside, errors over those of them that are judged and were found."""
    status = table.status[name]
    found = judged & (status == FOUND)
    distances = np.linalg.norm(table.errors_px[name][found], axis=-1).ravel()
    normalised = table.normalised[name][found].ravel()
    normalised = normalised[np.isfinite(normalised)]
    nothing = float("nan")
    enough = np.count_nonzero(found) >= _FEWEST
    return Figures(
        markers=int(np.count_nonzero(inside)),
        found=int(np.count_nonzero(found)),
        misidentified=int(np.count_nonzero(inside & (status == MISIDENTIFIED))),
        median_px=float(np.median(distances)) if enough else nothing,
        rms_px=float(np.sqrt(np.mean(distances**2))) if enough else nothing,
        q95_px=float(np.quantile(distances, 0.95)) if enough else nothing,
        normalised=float(np.mean(normalised)) if enough and len(normalised) else nothing,
    )


def misidentified(table: Table, name: str) -> int:
    """Markers given a wrong number or turn, those partly hidden included."""
    return int(np.count_nonzero(table.status[name] == MISIDENTIFIED))


def bins_json(bins: list[Bin]) -> list[dict[str, Any]]:
    """Bins in plain numbers; what is not known is null."""
    return [
        {
            "quantity": b.quantity or "all",
            "low": b.low,
            "high": b.high if np.isfinite(b.high) else None,
            "own": {name: _figures_json(figures) for name, figures in b.own.items()},
            "shared": {
                name: {"ours": _figures_json(ours), "peer": _figures_json(peer)}
                for name, (ours, peer) in b.shared.items()
            },
        }
        for b in bins
    ]


def _figures_json(figures: Figures) -> dict[str, float | int | None]:
    numbers = {**vars(figures), "rate": figures.rate}
    return {
        key: (None if isinstance(value, float) and not np.isfinite(value) else value)
        for key, value in numbers.items()
    }
