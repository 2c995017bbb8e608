"""Tables and figures that the commands round markers print."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


def residual_figures(adjusted: Any, views: Sequence[int]) -> dict[str, Any]:
    """Figures of some of a bundle's views: how many, how many wrong, residuals of the others."""
    chosen = np.isin(adjusted.bundle.view, views)
    used = chosen & adjusted.used
    wrong = len(np.unique(adjusted.bundle.view[chosen & ~adjusted.used]))
    residuals = adjusted.residuals[used]
    return {
        "views": len(views),
        "left_out": wrong,
        "rms_px": float(np.sqrt(np.mean(residuals**2))) if len(residuals) else None,
        "max_px": float(np.linalg.norm(residuals, axis=1).max()) if len(residuals) else None,
    }


def print_table(rows: Sequence[dict[str, Any]]) -> None:
    """Print rows with the same keys in columns."""
    words = [list(rows[0])] + [
        [f"{v:.4f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows
    ]
    widths = [max(len(row[k]) for row in words) for k in range(len(words[0]))]
    for row in words:
        print("  ".join(word.rjust(width) for word, width in zip(row, widths)))


def print_sigmas(kind: str, names: Sequence[str], covariance: Any) -> None:
    """Print the standard deviations of each pose, from a (6 N, 6 N) covariance."""
    sigmas = np.sqrt(np.diagonal(covariance)).reshape(-1, 6)
    for name, row in zip(names, sigmas):
        print(
            f"{kind} {name}: sigma {1e3 * np.linalg.norm(row[:3]):.2f} mm, "
            f"{np.degrees(np.linalg.norm(row[3:])):.4f} deg"
        )
