"""Angles in kernels."""

from __future__ import annotations

import math

from redetect.compiled import kernel


@kernel()
def wrapped(angle_rad: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi
