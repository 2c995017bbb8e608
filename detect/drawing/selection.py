"""Selection of frames of a run."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from detect.errors import DetectError
from detect.run import Frames, RunFrame
from detect.sources.image_names import image_name

_RANGE = re.compile(r"(\d*):(\d*)(?::(\d+))?")


@dataclass(frozen=True)
class FrameSelection:
    """Some frames of a run.

    Attributes
    ----------
    every : int
        Of the frames that are selected otherwise, only every so manieth.
    ranges : tuple of range
        Positions in the run.
    names : frozenset of str
        Images, as `detect.sources.image_names.image_name` gives them.

    Without ranges and names, all frames are selected.
    """

    every: int = 1
    ranges: tuple[range, ...] = ()
    names: frozenset[str] = frozenset()

    def expected(self, frames: Frames) -> int | None:
        """Approximate number of these frames; None if unknown."""
        if self.ranges or self.names or frames.expected is None:
            return None
        return -(-frames.expected // self.every)

    def of(self, frames: Frames) -> Iterator[tuple[int, RunFrame]]:
        """The selected frames, each with its position in the run, in the run's order."""
        everything = not (self.ranges or self.names)
        count = 0
        for position, frame in enumerate(frames):
            if (
                everything
                or any(position in part for part in self.ranges)
                or image_name(frame.step.prefix) in self.names
            ):
                if count % self.every == 0:
                    yield position, frame
                count += 1


def select_frames(frames: Frames, wanted: Sequence[str], every: int) -> FrameSelection:
    """Parse the selection of frames of a command line.

    Parameters
    ----------
    frames : Frames
        The run's.
    wanted : sequence of str
        Names of images, positions, and ranges FROM:TO[:STEP] of positions without the last. What is
        both a name and a position is a name.
    every : int
        Of these, every so manieth.

    Returns
    -------
    FrameSelection

    Raises
    ------
    DetectError
        If a name is no image's, a position is beyond the run, or no frame is left.
    """
    if every < 1:
        raise DetectError(f"every is {every}: expected 1 or more")
    if not wanted:
        return FrameSelection(every)
    asked = {image_name(word): word for word in wanted}
    names = [image_name(frame.step.prefix) for frame in frames]
    known = asked.keys() & set(names)
    ranges = [_positions(word, len(names)) for name, word in asked.items() if name not in known]
    return FrameSelection(every, tuple(ranges), frozenset(known))


def _positions(word: str, count: int) -> range:
    if word.isdecimal():
        if int(word) >= count:
            raise DetectError(f"frame {word}: expected a position from 0 to {count - 1}")
        return range(int(word), int(word) + 1)
    matched = _RANGE.fullmatch(word)
    if matched is None:
        raise DetectError(
            f"frame {word!r}: expected the name of an image of the run, a position or FROM:TO"
        )
    first, last, step = matched.groups()
    if step is not None and int(step) == 0:
        raise DetectError(f"frames {word}: the step is 0: expected 1 or more")
    positions = range(int(first or 0), min(int(last or count), count), int(step or 1))
    if not positions:
        raise DetectError(f"frames {word}: none of the run's {count} frames")
    return positions
