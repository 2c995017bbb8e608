"""The flags that say how a source is to be read. Nothing heavy is imported: `--help` needs them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from detect.errors import DetectError
from redetect.storage.bounds import NOT_NEGATIVE, demand, whole

#: Axes of a robot's poses: X forward and Y left, or the data set's X left and Y backward.
Axes = Literal["robotics", "dataset"]


@dataclass(frozen=True)
class SourceOptions:
    """Options of a source besides its name.

    Parameters
    ----------
    odometry : str
        Where the steps come from, if not from the source itself: a TUM trajectory (.tum; rows t x y
        z qx qy qz qw), counters of two wheels (.ticks; rows t left right), a file of STEP rows, a
        nav_msgs/Odometry topic of the bag (/odom), or none.
    odometry_axes : str
        Axes of the robot in a TUM trajectory: robotics (X forward, Y left) or dataset (X left, Y
        backward).
    wheel_base_m : float
        Distance of the two wheels whose ticks are counted.
    metres_per_tick : float
        Way of a wheel from one tick to the next.
    times : str
        File of the images' times, rows `prefix seconds`; by default <folder>.times among the
        images.
    image_topic : str
        The images of a bag, if there are several topics of them.
    base_frame : str
        The frame of the robot's base, on the floor, in a bag that holds the calibration itself
        (camera_info and tf_static); by default base_footprint.
    frames : int
        Stop after this many frames; 0 for all of them (of a live camera: until Ctrl-C).
    bits : int
        Significant bits of 16-bit images, 8 to 16; 0: the fewest of 8, 10, 12, 14 or 16 that hold
        the values of the first images.
    """

    odometry: str = ""
    odometry_axes: Axes = "robotics"
    wheel_base_m: float = 0.0
    metres_per_tick: float = 0.0
    times: str = ""
    image_topic: str = ""
    base_frame: str = ""
    frames: int = 0
    bits: int = 0

    def __post_init__(self) -> None:
        demand(
            self, DetectError,
            frames=whole(0), wheel_base_m=NOT_NEGATIVE, metres_per_tick=NOT_NEGATIVE,
        )  # fmt: skip
        if self.bits and not 8 <= self.bits <= 16:
            raise DetectError(f"bits is {self.bits}: expected 8 to 16, or 0")

    @property
    def plain(self) -> bool:
        """Whether nothing is said of steps and times."""
        return not (self.odometry or self.times or self.image_topic or self.base_frame)
