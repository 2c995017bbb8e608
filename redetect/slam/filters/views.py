"""Bearings of lines that wait for parallax, and the poses that are kept for them."""

from __future__ import annotations

from dataclasses import dataclass

# A line that was out of sight for this many frames is initialised again.
LONGEST_ABSENCE_FRAMES = 50
# Poses kept at most. If there are more, every other one is dropped: the span is what matters.
MOST_KEPT_POSES = 24
# Below this angle between its rays (rad) a line is not tried to be placed; and after it was, not
# before the angle has grown by this factor.
LEAST_PARALLAX_RAD, PARALLAX_GROWTH = 0.02, 1.05


@dataclass(frozen=True)
class View:
    """A bearing that waits."""

    frame: int  # its frame, whose pose is kept
    # The row.
    bearing_rad: float
    sigma_rad: float


class WaitingLines:
    """Views of lines that are not in the state yet.

    Attributes
    ----------
    slots : dict of int to int
        Where in the state the pose of a frame is kept.
    """

    def __init__(self) -> None:
        self.slots: dict[int, int] = {}
        self._views: dict[int, list[View]] = {}
        self._tried_rad: dict[int, float] = {}

    def worth_trying(self, number: int, parallax_rad: float) -> bool:
        """Whether the rays of a line differ more than when it was last tried to be placed."""
        if parallax_rad < self._tried_rad.get(number, LEAST_PARALLAX_RAD):
            return False
        self._tried_rad[number] = PARALLAX_GROWTH * parallax_rad
        return True

    def views(self, number: int) -> list[View]:
        """The stored views of a line, in the order of the frames."""
        return self._views.get(number, [])

    def keep(self, number: int, view: View) -> None:
        """Keep a row; the pose of its frame must be kept as well."""
        self._views.setdefault(number, []).append(view)

    def take(self, number: int) -> None:
        """Forget a line: it joined the state."""
        self._views.pop(number, None)
        self._tried_rad.pop(number, None)

    def forget_absent(self, frame: int) -> int:
        """Forget lines that are out of sight for long; returns how many views were dropped."""
        absent = [
            number
            for number, views in self._views.items()
            if frame - views[-1].frame > LONGEST_ABSENCE_FRAMES
        ]
        for number in absent:
            self._tried_rad.pop(number, None)
        return sum(len(self._views.pop(number)) for number in absent)

    def forget_all(self) -> int:
        """Forget all lines; returns how many views were dropped."""
        given_up = sum(map(len, self._views.values()))
        self._views.clear()
        return given_up

    def thin(self) -> int:
        """Drop every other pose if there are too many; returns how many views were dropped, too."""
        if len(self.slots) <= MOST_KEPT_POSES:
            return 0
        given_up = set(sorted(self.slots)[1:-1:2])
        before = sum(map(len, self._views.values()))
        kept = {
            number: [view for view in views if view.frame not in given_up]
            for number, views in self._views.items()
        }
        self._views = {number: views for number, views in kept.items() if views}
        return before - sum(map(len, self._views.values()))

    def release(self) -> list[int]:
        """Slots of poses that no view needs any more; they may be used for others."""
        needed = {view.frame for views in self._views.values() for view in views}
        free = [frame for frame in self.slots if frame not in needed]
        return [self.slots.pop(frame) for frame in free]
