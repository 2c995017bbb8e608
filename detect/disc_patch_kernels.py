"""Compiled loop that gathers the pixels to which a disc is fitted, with the floor that they see."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: Columns of the gathered pixels: floor x, y relative to the candidate, d(x, y)/d(u, v), grey
#: value, relative growth of the floor's step from one pixel to the next along the steep axis, and
#: whether the pixel is so near to the disc that it speaks for or against it.
FX, FY, XU, XV, YU, YV, GREY, GROWTH, NEAR = range(9)
PIXEL_COLUMNS = 9

#: A disc whose smaller half axis is below this is seen flat: blur reaches across it.
_FLAT_PX = 5.0
#: Pixels within this many radii, or this near to the edge, count in the explained variance.
_NEAR_RADII = 1.45
_NEAR_PX = 2.0


class FitSettings(NamedTuple):
    """What the fit is told, apart from the image and the candidates."""

    noise: float
    """Standard deviation of the noise, grey levels."""
    reach_radii: float
    """Pixels within this many radii of the candidate are fitted,"""
    reach_px: float
    """and those this near to the disc's edge, pixels,"""
    reach_blurs: float
    """or this many standard deviations of the blur."""
    radius_sigma: float
    """Standard deviation of the radius about the nominal one, relative."""
    blur_px: float
    """The blur about which the fitted one lies (along u), pixels,"""
    blur_sigma: float
    """and the standard deviation of its logarithm."""
    blur_ratio: float
    """Blur along v over blur along u, in pixels: 0.5 in single fields of interlaced frames."""


@njit(cache=True, error_model="numpy")
def gather_pixels(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    radius: float,
    blur: float,
    settings: FitSettings,
    pixels: NDArray[np.float64],
) -> tuple[int, int]:
    """Collect the pixels round a candidate whose blur is about `blur`, as the settings say.

    Returns their number, and how the disc is seen: 0 face on, 1 flat along v, 2 flat along u.
    """
    height, width = image.shape
    u1 = min(max(u0, 1), width - 2)
    v1 = min(max(v0, 1), height - 2)
    xu = 0.5 * (floor_xy[v1, u1 + 1, 0] - floor_xy[v1, u1 - 1, 0])
    yu = 0.5 * (floor_xy[v1, u1 + 1, 1] - floor_xy[v1, u1 - 1, 1])
    xv = 0.5 * (floor_xy[v1 + 1, u1, 0] - floor_xy[v1 - 1, u1, 0])
    yv = 0.5 * (floor_xy[v1 + 1, u1, 1] - floor_xy[v1 - 1, u1, 1])
    area = abs(xu * yv - xv * yu)
    if not area > 1e-14:
        return 0, 0
    flat = 0
    if max(math.hypot(xu, yu), math.hypot(xv, yv)) * _FLAT_PX > radius:
        flat = 1 if math.hypot(xv, yv) >= math.hypot(xu, yu) else 2
    # The window around the outline's ellipse, with room for perspective.
    limit = settings.reach_radii * radius
    ratio = settings.blur_ratio
    room = 1.35 * limit / area
    beyond_u = max(settings.reach_px, settings.reach_blurs * blur)
    beyond_v = max(settings.reach_px, settings.reach_blurs * blur * ratio)
    half_u = min(int(room * math.hypot(xv, yv) + beyond_u) + 1, width)
    half_v = min(int(room * math.hypot(xu, yu) + beyond_v) + 1, height)
    step = 1
    while (2 * half_u // step + 1) * (2 * half_v // step + 1) > pixels.shape[0]:
        step += 1
    x0 = floor_xy[v0, u0, 0]
    y0 = floor_xy[v0, u0, 1]
    count = 0
    for v in range(max(1, v0 - half_v), min(height - 1, v0 + half_v + 1), step):
        for u in range(max(1, u0 - half_u), min(width - 1, u0 + half_u + 1), step):
            x = float(floor_xy[v, u, 0] - x0)
            y = float(floor_xy[v, u, 1] - y0)
            r = math.sqrt(x * x + y * y)
            if not r < 4.0 * limit:
                continue
            xu = 0.5 * (floor_xy[v, u + 1, 0] - floor_xy[v, u - 1, 0])
            yu = 0.5 * (floor_xy[v, u + 1, 1] - floor_xy[v, u - 1, 1])
            xv = 0.5 * (floor_xy[v + 1, u, 0] - floor_xy[v - 1, u, 0])
            yv = 0.5 * (floor_xy[v + 1, u, 1] - floor_xy[v - 1, u, 1])
            gu = (xu * x + yu * y) / max(r, 1e-12)
            gv = (xv * x + yv * y) / max(r, 1e-12)
            per_px = math.hypot(gu, gv)
            per_blur = blur * math.hypot(gu, ratio * gv)
            off_edge = r - radius
            if (
                r > limit
                and not off_edge <= settings.reach_px * per_px
                and not off_edge <= settings.reach_blurs * per_blur
            ):
                continue
            near = r <= _NEAR_RADII * radius or off_edge <= _NEAR_PX * per_px
            pixels[count, NEAR] = 1.0 if near else 0.0
            pixels[count, FX] = x / radius
            pixels[count, FY] = y / radius
            pixels[count, XU] = xu / radius
            pixels[count, XV] = xv / radius
            pixels[count, YU] = yu / radius
            pixels[count, YV] = yv / radius
            pixels[count, GREY] = image[v, u]
            pixels[count, GROWTH] = 0.0
            if flat == 1:
                before = math.hypot(
                    floor_xy[v, u, 0] - floor_xy[v - 1, u, 0],
                    floor_xy[v, u, 1] - floor_xy[v - 1, u, 1],
                )
                after = math.hypot(
                    floor_xy[v + 1, u, 0] - floor_xy[v, u, 0],
                    floor_xy[v + 1, u, 1] - floor_xy[v, u, 1],
                )
                pixels[count, GROWTH] = 2.0 * (after - before) / (after + before)
            elif flat == 2:
                before = math.hypot(
                    floor_xy[v, u, 0] - floor_xy[v, u - 1, 0],
                    floor_xy[v, u, 1] - floor_xy[v, u - 1, 1],
                )
                after = math.hypot(
                    floor_xy[v, u + 1, 0] - floor_xy[v, u, 0],
                    floor_xy[v, u + 1, 1] - floor_xy[v, u, 1],
                )
                pixels[count, GROWTH] = 2.0 * (after - before) / (after + before)
            count += 1
    return count, flat
