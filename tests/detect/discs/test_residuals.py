"""What is read from the residuals of a fit, against the plain reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from detect.discs.descent import WORK
from detect.discs.least_squares import blur_width, correlated_area, residuals
from detect.discs.model import BY_RADIUS, SHARE, Blur, Disc
from tests.reference.discs import Pixels as ReferencePixels
from tests.reference.discs import background_of, edge_share

DISC = Disc(0.03, -0.02, 1.05, -0.3)
BLUR = Blur(0.8, 0.5)


def fitted(kind: str) -> tuple[NDArray[Any], int]:
    """A grid of 20 x 14 pixels per radius, a disc on it, and residuals of some kind."""
    rng = np.random.default_rng(4)
    v, u = (part.ravel() for part in np.mgrid[-24:25, -34:35].astype(float))
    even = np.ones_like(u)
    at = ReferencePixels(u / 20.0, v / 14.0, even / 20.0, 0 * even, 0 * even, even / 14.0)
    n = len(u)
    work = np.zeros(1, WORK)
    patch = work["patch"][0]
    for name in ("x", "y", "x1", "y1", "x2", "y2"):
        patch[name][:n] = getattr(at, name)
    design = patch["design"]
    design[:5, :n] = background_of(at)
    design[SHARE, :n] = edge_share(at, *DISC[:3], *BLUR)
    ahead, behind = (edge_share(at, *DISC[:2], DISC.radius + d, *BLUR) for d in (1e-4, -1e-4))
    design[BY_RADIUS, :n] = (ahead - behind) / 2e-4
    patch["weight"][:n] = np.hypot(at.x, at.y) < 1.45
    patch["pixel"][:n] = 1000 * (v + 24) + u + 34
    patch["residual"][:n] = {
        "noise": rng.normal(0.0, 3.0, n),
        "none": np.zeros(n),
        "texture": 20.0 * np.sin(at.x * 7.0) * np.cos(at.y * 5.0),
        "hidden": np.where(at.x > 0.4, -90.0 * design[SHARE, :n], 0.0),
        "saturated": np.clip(rng.normal(0.0, 60.0, n), -40.0, 40.0),
    }[kind]
    return work, n


def test_residuals_are_what_the_model_leaves() -> None:
    work, n = fitted("none")
    patch = work["patch"][0]
    rng = np.random.default_rng(1)
    design = patch["design"]
    design[:, :n] = rng.normal(0.0, 1.0, (11, n))
    values, bare = rng.normal(0.0, 1.0, 10), rng.normal(0.0, 1.0, 5)
    sums = residuals(patch, n, values, bare)
    columns = design[:, :n].astype(float)
    left, without = columns[10] - values @ columns[:10], columns[10] - bare @ columns[:5]
    np.testing.assert_allclose(patch["residual"][:n], left, atol=1e-5)
    weight = patch["weight"][:n].astype(float)
    expected = (np.sum(left**2), np.sum(weight * left**2), np.sum(weight * without**2))
    np.testing.assert_allclose(sums, expected, rtol=1e-4)


def test_correlated_residuals_say_less() -> None:
    """White noise counts in full; a process of correlation c as (1 + c)^2 / (1 - c)^2.

    Of the correlation, 1.5 standard deviations of its estimate are taken off.
    """
    rng = np.random.default_rng(2)
    work, n = fitted("noise")
    patch = work["patch"][0]
    assert correlated_area(patch, n) == pytest.approx(1.0, abs=0.1)
    walk = rng.normal(0.0, 1.0, n)
    for k in range(1, n):
        walk[k] = 0.5 * walk[k - 1] + np.sqrt(0.75) * walk[k]
    patch["residual"][:n] = walk
    c = 0.5 - 1.5 / np.sqrt(n)
    assert correlated_area(patch, n) == pytest.approx(((1.0 + c) / (1.0 - c)) ** 2, rel=0.2)
    patch["residual"][:n] = 0.0
    assert correlated_area(patch, n) == 1.0


def test_blur_width_is_the_mean_round_the_edge() -> None:
    work, n = fitted("none")
    width = blur_width(work["patch"][0], n, DISC, BLUR)
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    across = np.sqrt(
        (BLUR.first**2 + 1 / 12) * (np.cos(angle) / 20.0) ** 2
        + (BLUR.second**2 + 1 / 12) * (np.sin(angle) / 14.0) ** 2
    )
    assert width == pytest.approx(np.mean(across), rel=0.02)
