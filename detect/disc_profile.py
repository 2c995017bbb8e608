"""The grey-value profile of a blurred disc, tabulated."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

#: The table's reach: distances from the edge in units of the blur, and blur in units of the radius.
Z_LIMIT = 6.0
T_LIMIT = 2.5
_Z_NODES = 361
_T_NODES = 41


@lru_cache(maxsize=1)
def disc_profile() -> NDArray[np.float64]:
    """W(z, t): the share of a disc's contrast seen at signed distance z from its edge.

    A disc of radius 1 blurred by an isotropic Gaussian of width t has at distance 1 + z t from its
    centre the value W: the probability that a Gaussian about that point falls into the disc, which
    is a noncentral chi-square distribution of two degrees of freedom.

    Returns
    -------
    (41, 361) float64 array
        Rows t = 0 ... `T_LIMIT`, columns z = -`Z_LIMIT` ... `Z_LIMIT`. Read-only.
    """
    # Not scipy.stats: importing it takes more than a second.
    from scipy.special import chndtr, ndtr

    z = np.linspace(-Z_LIMIT, Z_LIMIT, _Z_NODES)
    t = np.linspace(0.0, T_LIMIT, _T_NODES)
    table = np.empty((_T_NODES, _Z_NODES))
    table[0] = ndtr(-z)
    blur = t[1:, None]
    # Inside the centre (1 + z t < 0) there is no point: the profile goes on by symmetry.
    distance = np.abs(1.0 + z * blur)
    table[1:] = chndtr(1.0 / blur**2, 2, (distance / blur) ** 2)
    table.setflags(write=False)
    return table
