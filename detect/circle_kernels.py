"""Compiled loops of the disc detector: the quality of every centre and its local maxima."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, error_model="numpy")
def quality_map(
    padded: NDArray[np.uint8],
    margin: int,
    samples: int,
    row_begin: NDArray[np.int32],
    row_end: NDArray[np.int32],
    usable: NDArray[np.bool_],
    run_bounds: NDArray[np.int32],
    run_start: NDArray[np.int32],
    run_du: NDArray[np.int32],
    run_dv: NDArray[np.int32],
    votes_inner: NDArray[np.uint8],
    votes_outer: NDArray[np.uint8],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
) -> None:
    """Otsu's quality of the two outlines' grey values around every usable centre.

    quality = between-class variance / total variance, both of the grey values that vote. All sums
    are of integers, so the only rounding is that of the one final division.

    Parameters
    ----------
    padded : (H + 2 margin, W + 2 margin) uint8
        The image, with zeros around: a zero adds nothing to any sum.
    margin, samples
        `DiscTable.margin_px`, `DiscTable.samples`.
    row_begin, row_end, usable, run_bounds, run_start, run_du, run_dv, votes_inner, votes_outer
        The table (see `lut.DiscTable`).
    quality : (H, W) float64
        Result, in [0, 1]; 0 for centres that are not usable and where all grey values are equal.
    contrast : (H, W) float32
        Result: mean grey value inside minus outside.
    """
    height, width = usable.shape
    scratch = np.empty((2 * samples, width), np.uint8)
    for v in range(height):
        begin = row_begin[v]
        end = row_end[v]
        if begin >= end:
            continue
        for k in range(2 * samples):
            last = run_bounds[v, k + 1] - 1
            for run in range(run_bounds[v, k], last + 1):
                u0 = run_start[run]
                u1 = run_start[run + 1] if run < last else end
                row = padded[v + run_dv[run] + margin]
                shift = run_du[run] + margin
                for u in range(u0, u1):
                    scratch[k, u] = row[u + shift]
        for u in range(begin, end):
            if not usable[v, u]:
                continue
            inner = 0
            outer = 0
            squares = 0
            for k in range(samples):
                a = int(scratch[k, u])
                b = int(scratch[samples + k, u])
                inner += a
                outer += b
                squares += a * a + b * b
            n_inner = int(votes_inner[v, u])
            n_outer = int(votes_outer[v, u])
            n = n_inner + n_outer
            total = inner + outer
            spread = n * squares - total * total
            difference = n_outer * inner - n_inner * outer
            if spread > 0:
                quality[v, u] = (difference * difference) / (float(n_inner * n_outer) * spread)
            contrast[v, u] = difference / (n_inner * n_outer)


@njit(cache=True, error_model="numpy")
def local_maxima(
    quality: NDArray[np.float64], threshold: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pixels of at least `threshold` that none of their 8 neighbours exceeds, in scan order.

    Connected pixels of equal quality are one maximum, at the one nearest to their centroid: a
    plateau is neither lost nor found twice.

    Returns
    -------
    columns, rows : (N,) int64
    """
    height, width = quality.shape
    found_u = []
    found_v = []
    visited = np.zeros(quality.shape, np.bool_)
    for v in range(height):
        for u in range(width):
            here = quality[v, u]
            if not here >= threshold or here <= 0.0 or visited[v, u]:
                continue
            highest = True
            level = False
            for vn in range(max(0, v - 1), min(height, v + 2)):
                for un in range(max(0, u - 1), min(width, u + 2)):
                    if quality[vn, un] > here:
                        highest = False
                    elif quality[vn, un] == here and (vn != v or un != u):
                        level = True
            if not level:
                if highest:
                    found_u.append(u)
                    found_v.append(v)
                continue
            # A plateau: gather all of it, and see whether anything around it is higher.
            plateau = [(v, u)]
            visited[v, u] = True
            highest = True
            k = 0
            while k < len(plateau):
                vp, up = plateau[k]
                k += 1
                for vn in range(max(0, vp - 1), min(height, vp + 2)):
                    for un in range(max(0, up - 1), min(width, up + 2)):
                        if quality[vn, un] > here:
                            highest = False
                        elif quality[vn, un] == here and not visited[vn, un]:
                            visited[vn, un] = True
                            plateau.append((vn, un))
            if highest:
                mean_v = 0.0
                mean_u = 0.0
                for vp, up in plateau:
                    mean_v += vp / len(plateau)
                    mean_u += up / len(plateau)
                best = 0
                least = np.inf
                for k in range(len(plateau)):
                    vp, up = plateau[k]
                    distance = (vp - mean_v) ** 2 + (up - mean_u) ** 2
                    if distance < least:
                        least = distance
                        best = k
                found_v.append(plateau[best][0])
                found_u.append(plateau[best][1])
    n = len(found_u)
    columns = np.empty(n, np.int64)
    rows = np.empty(n, np.int64)
    for k in range(n):
        columns[k] = found_u[k]
        rows[k] = found_v[k]
    # A plateau's representative may come later in the scan than where it was met.
    order = np.argsort(rows * width + columns)
    return columns[order], rows[order]


@njit(cache=True, error_model="numpy")
def suppress_neighbours(
    floor_xy: NDArray[np.float64], score: NDArray[np.float64], separation: float
) -> NDArray[np.bool_]:
    """Which of some floor positions to keep so that no two are closer than `separation`.

    The best by score stay; of equal ones the first.

    Parameters
    ----------
    floor_xy : (N, 2) float64
        Positions, metres.
    score : (N,) float64
    separation : float
        Metres.

    Returns
    -------
    (N,) bool
    """
    n = len(score)
    kept = np.zeros(n, np.bool_)
    order = np.argsort(-score, kind="mergesort")
    chosen = np.empty(n, np.int64)
    count = 0
    for i in order:
        alone = True
        for k in range(count):
            dx = floor_xy[i, 0] - floor_xy[chosen[k], 0]
            dy = floor_xy[i, 1] - floor_xy[chosen[k], 1]
            if dx * dx + dy * dy < separation * separation:
                alone = False
                break
        if alone:
            kept[i] = True
            chosen[count] = i
            count += 1
    return kept
