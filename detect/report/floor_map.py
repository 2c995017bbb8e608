"""The floor from above: where the discs of a run were found, and where they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from detect.drawing.inputs import SeenRows
from detect.report.figures import DATA, MARK, REFERENCE
from detect.seen import circle_on_floor
from detect.view_command import summed_steps
from redetect.landmarks import Frame, circle_arrays
from redetect.reporting.page import Part, figure_file, image_part

FloatArray = NDArray[np.float64]

_SIGMAS = 3.0
_LARGEST_IN = (7.6, 9.0)
_SMALLEST_IN = 2.5


def floor_map(rows: Sequence[SeenRows]) -> Part | None:
    """Discs found over the run, and those of the reference, along the sum of its steps.

    Forward at the start is up, left is left. None where there are no discs.
    """
    frames = [seen.circles for seen in rows if seen.circles is not None]
    if not any(frame.circles for frame in frames):
        return None
    poses = summed_steps(frame.step for frame in frames)
    ahead = np.array([1.0, -1.0])  # X is to the left, Y backward
    found = [_placed(frame, pose) for frame, pose in zip(frames, poses[1:])]
    references = [seen.reference_circles for seen in rows if seen.circles is not None]
    true = [
        _placed(frame, pose)[0]
        for frame, pose in zip(references, poses[1:])
        if frame is not None and frame.circles
    ]
    centres = np.concatenate([xy for xy, _ in found])
    ellipses = np.concatenate([outlines for _, outlines in found])
    path = ahead * poses[:, :2]
    everything = np.concatenate([path, ahead * centres, *(ahead * xy for xy in true)])
    low, high = everything.min(axis=0) - 0.3, everything.max(axis=0) + 0.3
    scale = min(np.array(_LARGEST_IN) / (high - low))
    size = np.maximum(scale * (high - low), _SMALLEST_IN)
    with figure_file((float(size[0]), float(size[1])), "svg") as (figure, content):
        axes = figure.subplots()
        axes.plot(path[:, 0], path[:, 1], color=REFERENCE, lw=1.0, label="path by the odometry")
        if true:
            x, y = (ahead * np.concatenate(true)).T
            axes.plot(x, y, "+", color=MARK, ms=6, mew=0.7, label="reference")
        gaps = np.concatenate([ellipses, np.full((len(ellipses), 1, 2), np.nan)], axis=1)
        x, y = (ahead * gaps.reshape(-1, 2)).T
        axes.plot(x, y, color=DATA, lw=0.7, label="found")
        axes.set_xlim(high[0], low[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
        axes.set_xlabel("to the left / m")
        axes.set_ylabel("forward / m")
        axes.grid(alpha=0.25, lw=0.6)
        axes.legend(fontsize=8)
    words = (
        f"The floor from above: the ellipse of {_SIGMAS:g} standard deviations of each disc of "
        "each frame, along the path that the odometry sums up to."
    )
    return image_part(words, content.getvalue(), "svg+xml", 96.0 * size[0], 96.0 * size[1])


def _placed(frame: Frame, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N, 2) centres of a frame's discs and (N, P, 2) outlines of their ellipses, from a pose."""
    discs = circle_arrays(frame.circles)
    values, vectors = np.linalg.eigh(discs.covariance)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    circle = circle_on_floor((0.0, 0.0), _SIGMAS, 32)
    outlines = discs.xy[:, None, :] + np.einsum("nij,kj->nki", roots, circle)
    sine, cosine = np.sin(pose[2]), np.cos(pose[2])
    turn = np.array([[cosine, sine], [-sine, cosine]])
    closed = np.concatenate([outlines, outlines[:, :1]], axis=1)
    return discs.xy @ turn + pose[:2], closed @ turn + pose[:2]
