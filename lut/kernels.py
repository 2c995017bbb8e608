"""Compiled loops that build tables: arrays in, arrays out.

Numba's cache notices a change of this file, but not one of `camera.kernels`, whose function is
compiled into these: whoever changes that one has to touch this file as well.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from camera.kernels import project_floor_point


@njit(cache=True, error_model="numpy")
def _inside(us: float, vs: float, width: int, height: int) -> bool:
    """Whether the pixel nearest to a position belongs to the image; NaN does not."""
    return 0.0 <= us + 0.5 < width and 0.0 <= vs + 0.5 < height


@njit(cache=True, error_model="numpy")
def count_votes(
    numbers: NDArray[np.float64],
    floor_xy: NDArray[np.float64],
    candidate: NDArray[np.bool_],
    ring: NDArray[np.float64],
    votes: NDArray[np.uint8],
) -> None:
    """Count the samples of one outline that fall inside the image, for candidate centres.

    Parameters
    ----------
    numbers : (22,) float64
        `camera.kernels.camera_numbers`.
    floor_xy : (H, W, 2) float64
        Floor position of each pixel, metres.
    candidate : (H, W) bool
        Centres to look at; the others get no votes.
    ring : (K, 2) float64
        The outline's samples relative to its centre, metres.
    votes : (H, W) uint8
        Result.
    """
    height, width = candidate.shape
    for v in range(height):
        for u in range(width):
            if not candidate[v, u]:
                continue
            inside = 0
            for k in range(ring.shape[0]):
                us, vs = project_floor_point(
                    numbers, floor_xy[v, u, 0] + ring[k, 0], floor_xy[v, u, 1] + ring[k, 1]
                )
                if _inside(us, vs, width, height):
                    inside += 1
            votes[v, u] = inside


@njit(cache=True, error_model="numpy")
def encode_runs(
    numbers: NDArray[np.float64],
    floor_xy: NDArray[np.float64],
    usable: NDArray[np.bool_],
    row_begin: NDArray[np.int32],
    row_end: NDArray[np.int32],
    rings: NDArray[np.float64],
    capacity: int,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], int]:
    """Run-length encode the samples' offsets along each row.

    Samples outside the image, or that the camera does not see at all, get the pixel above the
    image's first one in their centre's column: one run, and no farther outside than that.

    Parameters
    ----------
    numbers, floor_xy
        As in `count_votes`.
    usable : (H, W) bool
        Usable centres. Others between a row's ends continue the run they lie in while that stays
        inside the image.
    row_begin, row_end : (H,) int32
        Columns between which a row's usable centres lie.
    rings : (2K, 2) float64
        Samples of the inner and then the outer outline relative to the centre, metres.
    capacity : int
        Room for runs.

    Returns
    -------
    run_bounds : (H, 2K + 1) int32
    run_start, run_du, run_dv : (capacity,) int32
    count : int
        Number of runs needed; if larger than `capacity`, the rest was not written.
    """
    height, width = usable.shape
    samples = rings.shape[0]
    run_bounds = np.zeros((height, samples + 1), np.int32)
    run_start = np.empty(capacity, np.int32)
    run_du = np.empty(capacity, np.int32)
    run_dv = np.empty(capacity, np.int32)
    count = 0
    for v in range(height):
        for k in range(samples):
            run_bounds[v, k] = count
            du = 0
            dv = 0
            fresh = True
            for u in range(row_begin[v], row_end[v]):
                du_here = 0
                dv_here = -1 - v
                if usable[v, u]:
                    us, vs = project_floor_point(
                        numbers, floor_xy[v, u, 0] + rings[k, 0], floor_xy[v, u, 1] + rings[k, 1]
                    )
                    if _inside(us, vs, width, height):
                        du_here = math.floor(us + 0.5) - u
                        dv_here = math.floor(vs + 0.5) - v
                elif 0 <= u + du < width:
                    continue
                if fresh or du_here != du or dv_here != dv:
                    du = du_here
                    dv = dv_here
                    if count < capacity:
                        run_start[count] = u
                        run_du[count] = du
                        run_dv[count] = dv
                    count += 1
                    fresh = False
        run_bounds[v, samples] = count
    return run_bounds, run_start, run_du, run_dv, count
