"""Where the robot goes: a polyline with rounded corners, driven step by step, and its tilt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tools.simulator.scene import FloatArray

_DENSE_M = 0.01
_DENSE_RAD = 0.01
_TURNING_COST_M = 0.6  # a radian of turning takes as long as so many metres
_REVERSAL_RAD = np.radians(150.0)


@dataclass(frozen=True)
class DriveStyle:
    """How the robot drives."""

    step_m: float = 0.172
    """Mean way between frames on a straight stretch (m); turning shortens it."""
    step_spread: float = 0.08
    """Slow change of the speed, as a share (standard deviation)."""
    weave_m: float = 0.12
    """Slow sideways deviation from the route (m, standard deviation)."""
    corner_m: float = 0.8
    """Radius of rounded corners (m)."""
    tilt_deg: float = 0.6
    """Standard deviation of pitch and roll, each (deg)."""
    tilt_frames: float = 6.0
    """Frames over which the tilt stays similar."""
    constant_tilt_deg: tuple[float, float] = (0.0, 0.0)
    """Constant tilt (p, q) on top (deg)."""


def drive(route: ArrayLike, steps: int, style: DriveStyle, rng: np.random.Generator) -> FloatArray:
    """Drive along a route.

    Parameters
    ----------
    route : (K, 2) array
        Corners of the way (m); where it reverses, the robot turns on the spot.
    steps : int
        Steps to make.
    style : DriveStyle
        Speed, weaving and corners.
    rng : numpy Generator
        Source of the weaving and of the changes of speed.

    Returns
    -------
    (steps + 1, 3) array
        Poses x, y (m) and heading (rad, continuous) before the first step and after each.

    Raises
    ------
    ValueError
        If the route ends before the steps do.
    """
    dense = _weaving(_rounded(np.asarray(route, dtype=np.float64), style.corner_m), style, rng)
    way = np.hypot(*np.diff(dense[:, :2], axis=0).T)
    turn = np.abs(np.diff(dense[:, 2]))
    cost = np.concatenate([[0.0], np.cumsum(way + _TURNING_COST_M * turn)])
    pace = style.step_m * np.exp(style.step_spread * smooth_noise(steps, 25.0, rng))
    at = np.concatenate([[0.0], np.cumsum(pace)])
    if at[-1] > cost[-1]:
        raise ValueError(
            f"the route is over after {np.searchsorted(at, cost[-1]) - 1} steps: expected {steps}"
        )
    return np.stack([np.interp(at, cost, dense[:, k]) for k in range(3)], axis=-1)


def robot_tilt(frames: int, style: DriveStyle, rng: np.random.Generator) -> FloatArray:
    """(frames, 2) tilt (p, q) of a moving robot (rad), smooth from frame to frame.

    See `tools.simulator.poses.level_from_tilted` for the sign and axes.
    """
    noise = np.stack([smooth_noise(frames, style.tilt_frames, rng) for _ in range(2)], axis=-1)
    return np.asarray(np.radians(style.tilt_deg * noise + np.array(style.constant_tilt_deg)))


def smooth_noise(count: int, length: float, rng: np.random.Generator) -> FloatArray:
    """(count,) Gaussian noise of unit variance that stays similar over `length` samples."""
    from scipy.ndimage import gaussian_filter1d

    margin = int(np.ceil(4.0 * length))
    white = rng.standard_normal(count + 2 * margin)
    smooth = gaussian_filter1d(white, length, mode="constant")[margin : margin + count]
    # Variance of a Gaussian-weighted mean of white noise.
    return np.asarray(smooth * np.sqrt(2.0 * length * np.sqrt(np.pi)))


def _rounded(route: FloatArray, radius: float) -> FloatArray:
    """Dense poses along the route with rounded corners and turns on the spot."""
    leg = np.diff(route, axis=0)
    length = np.hypot(leg[:, 0], leg[:, 1])
    keep = np.concatenate([[True], length > 1e-9])
    route = route[keep]
    leg = np.diff(route, axis=0)
    length = np.hypot(leg[:, 0], leg[:, 1])
    unit = leg / length[:, None]
    # Heading h looks along (sin h, -cos h).
    heading = np.arctan2(unit[:, 0], -unit[:, 1])
    pieces: list[FloatArray] = []
    at, facing = route[0], float(heading[0])
    for k in range(len(leg)):
        end = route[k + 1]
        turn = 0.0
        if k + 1 < len(leg):
            turn = float(np.pi - np.mod(np.pi - (heading[k + 1] - heading[k]), 2.0 * np.pi))
        reversal = abs(turn) > _REVERSAL_RAD
        cut = 0.0
        if k + 1 < len(leg) and not reversal and abs(turn) > 1e-6:
            cut = min(radius * np.tan(0.5 * abs(turn)), 0.45 * length[k], 0.45 * length[k + 1])
        stop = end - cut * unit[k]
        pieces.append(_straight(at, stop, facing))
        if cut > 0.0:
            arc = _arc(stop, facing, turn, cut / np.tan(0.5 * abs(turn)))
            pieces.append(arc)
            at, facing = arc[-1, :2], float(arc[-1, 2])
        else:
            count = max(int(abs(turn) / _DENSE_RAD), 1)
            spin = facing + turn * np.arange(1, count + 1) / count
            pieces.append(np.column_stack([np.tile(stop, (count, 1)), spin]))
            at, facing = stop, facing + turn
    return np.concatenate(pieces)


def _straight(start: FloatArray, end: FloatArray, heading: float) -> FloatArray:
    count = max(int(np.hypot(*(end - start)) / _DENSE_M), 1)
    share = np.arange(1, count + 1)[:, None] / count
    return np.column_stack([start + share * (end - start), np.full(count, heading)])


def _arc(start: FloatArray, heading: float, turn: float, radius: float) -> FloatArray:
    count = max(int(radius * abs(turn) / _DENSE_M), 8)
    angle = heading + turn * np.arange(1, count + 1) / count
    # Along an arc of radius r, d(position) = (sin h, -cos h) r dh.
    signed = radius * np.sign(turn)
    x = start[0] + signed * (np.cos(heading) - np.cos(angle))
    y = start[1] + signed * (np.sin(heading) - np.sin(angle))
    return np.column_stack([x, y, angle])


def _weaving(dense: FloatArray, style: DriveStyle, rng: np.random.Generator) -> FloatArray:
    """Shift the way slowly sideways; the robot keeps looking along it."""
    length = 1.6 / _DENSE_M
    off = style.weave_m * smooth_noise(len(dense), length, rng)
    slope = np.gradient(off) / _DENSE_M
    left = np.column_stack([np.cos(dense[:, 2]), np.sin(dense[:, 2])])
    # On the spot nothing shifts: the same slope would be driven in no time.
    moving = np.concatenate([[0.0], np.hypot(*np.diff(dense[:, :2], axis=0).T)]) > 1e-9
    woven = dense.copy()
    woven[:, :2] += off[:, None] * left
    woven[:, 2] += np.where(moving, np.arctan(slope), 0.0)
    return woven
