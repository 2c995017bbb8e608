"""TUM trajectories as odometry: rows ``t x y z qx qy qz qw``, seconds, metres, unit quaternions.

The robot moves on the floor: of its attitude the heading is taken, of its position x and y.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from pathlib import Path

from detect.errors import DetectError
from detect.sources.interface import FARTHEST, TimedPose
from detect.sources.options import Axes

_COLUMNS = 8
_UNIT = 1e-2
_LARGEST_ROW = 65536


class TumTrajectory:
    """A TUM trajectory, read on demand.

    Parameters
    ----------
    path : path
    axes : {"robotics", "dataset"}
        The robot's: X forward and Y left, or X left and Y backward.
    """

    def __init__(self, path: Path, axes: Axes = "robotics") -> None:
        self.path = path
        self.name = str(path)
        self._axes = axes

    def __iter__(self) -> Generator[TimedPose, None, None]:
        try:
            with self.path.open(encoding="utf-8-sig") as stream:
                for number, line in enumerate(stream, start=1):
                    words = line[:_LARGEST_ROW].partition("#")[0].replace(",", " ").split()
                    if words:
                        yield self._pose(words, number)
        except FileNotFoundError:
            raise DetectError(f"{self.path}: no such TUM trajectory") from None
        except UnicodeDecodeError:
            raise DetectError(f"{self.path}: is no text: expected a TUM trajectory") from None
        except OSError as error:
            raise DetectError(f"{self.path}: cannot be read: {error.strerror}") from None

    def _pose(self, words: list[str], number: int) -> TimedPose:
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) != _COLUMNS or not all(map(math.isfinite, values)):
            raise DetectError(
                f"{self.path}:{number}: {' '.join(words)[:60]!r}: "
                "expected 8 numbers: t x y z qx qy qz qw"
            )
        time_s, x, y, _, *quaternion = values
        if max(abs(x), abs(y)) > FARTHEST:
            raise DetectError(f"{self.path}:{number}: expected x and y of at most {FARTHEST:g} m")
        if abs(math.hypot(*quaternion) - 1.0) > _UNIT:
            raise DetectError(f"{self.path}:{number}: qx qy qz qw: expected a unit quaternion")
        theta = heading_rad(*quaternion)
        if self._axes == "dataset":
            # Only the robot's own axes differ; the fixed frame is the trajectory's, whatever it is.
            theta -= 0.5 * math.pi
        return TimedPose(time_s, x, y, theta)


def heading_rad(qx: float, qy: float, qz: float, qw: float) -> float:
    """The heading of a quaternion: where the robot's X axis points, seen from above (rad)."""
    return math.atan2(2.0 * (qw * qz + qx * qy), qw**2 + qx**2 - qy**2 - qz**2)
