"""Checks that all parts of a run are connected, so that one map can represent it."""

from __future__ import annotations

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.slam.errors import SlamError
from redetect.slam.recording import Recording

#: Beyond these standard deviations a step gives no information about the robot's motion.
MOST_STEP_SIGMA_M = 100.0
MOST_STEP_SIGMA_RAD = float(np.pi)
#: Parts of a run are connected if they share this many landmarks; one leaves a rotation free.
FEWEST_SHARED = 2


def lost_steps(step_covariance: FloatArray) -> IntArray:
    """Steps whose odometry gives no information.

    Takes `step_covariance` (N, 3, 3); returns (L,).
    """
    way = np.linalg.eigvalsh(step_covariance[:, :2, :2])[:, -1]
    lost = (way > MOST_STEP_SIGMA_M**2) | (step_covariance[:, 2, 2] > MOST_STEP_SIGMA_RAD**2)
    return np.flatnonzero(lost)


def check_connected(recording: Recording, name: str) -> None:
    """See that landmarks join the parts between which odometry is lost."""
    lost = lost_steps(recording.step_covariance)
    if len(lost) == 0:
        return
    seen: list[set[tuple[str, int]]] = [set() for _ in range(len(lost) + 1)]
    circles, lines = recording.circles, recording.lines
    for part, number in zip(np.searchsorted(lost, circles.frame, side="right"), circles.ids):
        if number >= 0:
            seen[part].add(("disc", int(number)))
    for part, ids in zip(np.searchsorted(lost, lines.frame, side="right"), lines.ids):
        seen[part].update(("line", i) for i in ids)
    # Parts grow together as long as any two share enough.
    joined = [({k}, landmarks) for k, landmarks in enumerate(seen)]
    grown = True
    while grown:
        grown = False
        for a in range(len(joined)):
            for b in range(len(joined) - 1, a, -1):
                if len(joined[a][1] & joined[b][1]) >= FEWEST_SHARED:
                    parts, landmarks = joined.pop(b)
                    joined[a] = (joined[a][0] | parts, joined[a][1] | landmarks)
                    grown = True
    if len(joined) == 1:
        return
    # Name the first step with parts on both sides that nothing joins.
    group = {part: k for k, (parts, _) in enumerate(joined) for part in parts}
    broken = next(k for k in range(len(lost)) if group[k] != group[k + 1])
    step = int(lost[broken])
    covariance = recording.step_covariance[step]
    shared = len(joined[group[broken]][1] & joined[group[broken + 1]][1])
    sigma = np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    raise SlamError(
        f"{name}: disconnected at step {step + 1} ({recording.prefixes[step]}): its odometry is "
        f"lost (standard deviations {sigma:.3g} m, {np.sqrt(covariance[2, 2]):.3g} rad), and the "
        f"parts before and after share {shared} landmarks: expected at least {FEWEST_SHARED}"
    )
