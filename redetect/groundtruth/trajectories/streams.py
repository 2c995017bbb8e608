"""Poses over time: their files, interpolation, and rigid alignment with other trajectories.

Files are RAWSEEDS' comma-separated streams and TUM trajectories. A RAWSEEDS stream has
a row per pose: time (s), x, y (m), heading theta (rad), and for ground truth the 3x3 covariance of
(x, y, theta) row by row. It has no comments and no header.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import PathLike, parse_numbers, read_rows
from redetect.groundtruth.trajectories import se3
from redetect.plane import fitted, pose_differences, rotation, with_heading
from redetect.storage import write_bytes

#: Half of the last digit of the covariances in RAWSEEDS' own files.
RAWSEEDS_ROUNDING = 5e-7

#: Which of two streams is interpolated to the times of the other.
Interpolated = Literal["truth", "poses"]

_POSE_COLUMNS = 4
_COVARIANCE_COLUMNS = 13


@dataclass(frozen=True, eq=False)
class PlanarPoses:
    """Poses of a robot on the floor over time.

    Raises `GroundTruthError` if a number is not finite or times decrease.
    """

    times_s: FloatArray  # (N,): seconds, not decreasing
    poses: FloatArray  # (N, 3): x, y (m), theta (rad), which may be beyond +-pi, as in real streams
    covariances: FloatArray | None = None  # (N, 3, 3); may be singular due to rounding in files

    def __post_init__(self) -> None:
        count = len(self.times_s)
        columns = {"times": self.times_s, "poses": self.poses, "covariances": self.covariances}
        for name, values in columns.items():
            if values is not None and not np.all(np.isfinite(values)):
                raise GroundTruthError(f"{name} contain a number that is not finite")
        descending = np.flatnonzero(np.diff(self.times_s) < 0.0)
        if descending.size:
            i = int(descending[0])
            raise GroundTruthError(
                f"pose {i + 2} of {count} is from {self.times_s[i + 1]:.6f} s, before pose {i + 1} "
                f"from {self.times_s[i]:.6f} s: expected times in order"
            )

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def continuous(self) -> FloatArray:
        """(N, 3) the poses, with headings that do not jump by full turns."""
        return np.column_stack([self.poses[:, :2], np.unwrap(self.poses[:, 2])])

    def only(self, chosen: NDArray[Any] | slice) -> PlanarPoses:
        """The chosen poses, by a mask, indices or a slice."""
        covariances = None if self.covariances is None else self.covariances[chosen]
        return PlanarPoses(self.times_s[chosen], self.poses[chosen], covariances)

    def during(self, from_s: float, to_s: float) -> BoolArray:
        """(N,) mask of the poses in an interval of time, its ends included."""
        return np.asarray((self.times_s >= from_s) & (self.times_s <= to_s))


def last_of_each_time(poses: PlanarPoses) -> PlanarPoses:
    """Keep only the last of all poses with the same time.

    If time stamps are coarser than samples, as with buffers that are read occasionally, several
    poses have the same time. The robot moved between them, but its speed cannot be computed.
    """
    last = np.append(np.diff(poses.times_s) > 0.0, True)[: len(poses)]
    return poses if np.all(last) else poses.only(last)


def read_planar_poses(path: PathLike) -> PlanarPoses:
    """Read a RAWSEEDS stream, with or without covariances.

    All rows have 4, or all have 13, numbers separated by commas or blanks; blank lines and `#`
    comments, which the real files do not have, are skipped. Raises `GroundTruthError` if the file
    cannot be read or a row is malformed; the message names file and line.
    """
    rows: list[list[float]] = []
    lines: list[int] = []
    allowed: tuple[int, ...] = (_POSE_COLUMNS, _COVARIANCE_COLUMNS)
    for line, words in read_rows(path):
        if len(words) not in allowed:
            expected = f"{' or '.join(map(str, allowed))}: t, x, y, theta"
            expected += " and 9 of covariance" if _COVARIANCE_COLUMNS in allowed else ""
            raise GroundTruthError(f"{path}:{line}: {len(words)} numbers: expected {expected}")
        allowed = (len(words),)
        rows.append(parse_numbers(path, line, words))
        if len(rows) > 1 and rows[-1][0] < rows[-2][0]:
            raise GroundTruthError(
                f"{path}:{line}: time {rows[-1][0]:.6f} s is before the row above: expected in "
                "order"
            )
        lines.append(line)
    if not rows:
        raise GroundTruthError(f"{path}: contains no poses")
    table = np.array(rows)
    covariances = table[:, 4:].reshape(-1, 3, 3) if allowed == (_COVARIANCE_COLUMNS,) else None
    if covariances is not None:
        apart = np.abs(covariances - covariances.transpose(0, 2, 1)).max(axis=(1, 2))
        wrong = apart > 2.0 * RAWSEEDS_ROUNDING + 1e-5 * np.abs(covariances).max(axis=(1, 2))
        if wrong.any():
            raise GroundTruthError(
                f"{path}:{lines[wrong.argmax()]}: a covariance that is not symmetric, 3 x 3"
            )
    return PlanarPoses(table[:, 0].copy(), table[:, 1:4].copy(), covariances)


def write_planar_poses(path: PathLike, poses: PlanarPoses, *, overwrite: bool = False) -> None:
    """Write poses as a RAWSEEDS stream, whole or not at all.

    Covariances have 12 decimals: the real files have 6, which rounds variances below (0.7 mm)^2 to
    zero and makes matrices singular.
    """
    columns, formats = [poses.times_s[:, None], poses.poses], ["%.6f"] * _POSE_COLUMNS
    if poses.covariances is not None:
        columns.append(poses.covariances.reshape(-1, 9))
        formats += ["%.12f"] * 9
    text = io.StringIO()
    np.savetxt(text, np.hstack(columns), formats, ",")
    write_bytes(path, text.getvalue().encode(), overwrite=overwrite)


def format_tum(times_s: FloatArray, world_from_robot: FloatArray) -> str:
    """Format (N,) times and (N, 4, 4) poses as a TUM trajectory: t x y z qx qy qz qw."""
    quaternions = se3.quaternion_xyzw(world_from_robot) if len(times_s) else np.zeros((0, 4))
    return "".join(
        " ".join([f"{t:.6f}", *(f"{v:.6f}" for v in pose[:3, 3]), *(f"{v:.9f}" for v in q)]) + "\n"
        for t, pose, q in zip(times_s, world_from_robot, quaternions)
    )


def segments_between_gaps(times_s: FloatArray, largest_gap_s: float) -> list[slice]:
    """Slices of the samples (N,) between gaps longer than a limit."""
    cuts = np.flatnonzero(np.diff(times_s) > largest_gap_s) + 1
    ends = [0, *cuts.tolist(), len(times_s)]
    return [slice(a, b) for a, b in pairwise(ends) if b > a]


def interpolate_poses(
    poses: PlanarPoses, times_s: FloatArray, largest_gap_s: float = np.inf
) -> tuple[PlanarPoses, BoolArray]:
    """Interpolate poses and covariances linearly at ascending times (N,), wrapping headings.

    Between neighbours farther apart than the largest gap there are none. Returns the interpolated
    poses, and a mask (N,) of the times that have one.
    """
    if len(poses) == 0:
        raise GroundTruthError("no poses to interpolate between")
    after = np.clip(np.searchsorted(poses.times_s, times_s, side="left"), 0, len(poses) - 1)
    before = np.where(poses.times_s[after] == times_s, after, np.maximum(after - 1, 0))
    inside = (times_s >= poses.times_s[0]) & (times_s <= poses.times_s[-1])
    gap = poses.times_s[after] - poses.times_s[before]
    known = inside & (gap <= largest_gap_s)
    before, after, gap = before[known], after[known], gap[known]
    part = np.where(gap > 0.0, (times_s[known] - poses.times_s[before]) / np.where(gap, gap, 1), 0)
    change = pose_differences(poses.poses[after], poses.poses[before])
    between = poses.poses[before] + part[:, None] * change
    covariances = None
    if poses.covariances is not None:
        a, b = poses.covariances[before], poses.covariances[after]
        covariances = a + part[:, None, None] * (b - a)
    return PlanarPoses(times_s[known], between, covariances), known


def matched_streams(
    poses: PlanarPoses,
    truth: PlanarPoses,
    *,
    largest_gap_s: float = 0.5,
    interpolate: Interpolated = "truth",
) -> tuple[PlanarPoses, PlanarPoses, int]:
    """Both streams at common times, and the number of times without a match.

    `interpolate`: `truth` at the poses' times, or `poses` at the truth's times (RAWSEEDS'
    definition), but not across longer gaps. Raises `GroundTruthError` if no times are common.
    """
    if len(poses) == 0 or len(truth) == 0:
        raise GroundTruthError(
            f"{len(poses)} poses and {len(truth)} of the truth: expected at least one of each"
        )
    still, moving = (poses, truth) if interpolate == "truth" else (truth, poses)
    at_times, known = interpolate_poses(moving, still.times_s, largest_gap_s)
    kept = still.only(known)
    mine, theirs = (kept, at_times) if interpolate == "truth" else (at_times, kept)
    if len(mine) == 0:
        raise GroundTruthError(
            f"no times in common with the truth: poses from {poses.times_s[0]:.3f} to "
            f"{poses.times_s[-1]:.3f} s, truth from {truth.times_s[0]:.3f} to "
            f"{truth.times_s[-1]:.3f} s, gaps of at most {largest_gap_s:g} s interpolated"
        )
    return mine, theirs, int((~known).sum())


def planar_alignment(poses: PlanarPoses, truth: PlanarPoses) -> FloatArray:
    """(3,) rigid motion x, y (m), theta (rad) that best aligns the poses' positions with the truth.

    Both have the same times. Least squares in the plane (Horn 1987), without scale; unlike an
    alignment in space, it cannot mirror the path.
    """
    if len(poses) < 2:
        raise GroundTruthError(f"{len(poses)} poses: expected 2 or more to align them")
    return fitted(poses.poses[:, :2], truth.poses[:, :2])


def moved_poses(poses: PlanarPoses, motion: FloatArray) -> PlanarPoses:
    """Poses, and their covariances, after a rigid motion (x, y, theta) of the world."""
    turn = with_heading(rotation(motion[2]))
    covariances = None if poses.covariances is None else turn @ poses.covariances @ turn.T
    return PlanarPoses(poses.times_s, poses.poses @ turn.T + motion, covariances)
