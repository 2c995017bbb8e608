"""Pairs rows of two runs: frames by image, rows one to one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from detect.comparison.result import CompareError
from detect.sources.image_names import image_name
from landmarks import Association, CircleLandmark, Frame, LineLandmark

RowType = TypeVar("RowType", bound=CircleLandmark | LineLandmark)

_LONGEST_SHOWN_NAME = 80


@dataclass(frozen=True, slots=True)
class PairedFrames(Generic[RowType]):
    """The rows of two runs, image by image.

    Attributes
    ----------
    frames : tuple of (str, rows, rows)
        An image's name, its reference rows and its detected rows.
    only_in_reference, only_in_detected : tuple of str
        Images that only one run has.
    """

    frames: tuple[tuple[str, tuple[RowType, ...], tuple[RowType, ...]], ...]
    only_in_reference: tuple[str, ...]
    only_in_detected: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FrameMatch(Generic[RowType]):
    """One frame's rows that count, and which of them belong together.

    Attributes
    ----------
    name : str
        The image.
    reference, detected : sequence of rows
        Those that count.
    pairs : Association
        Of reference (first) and detected rows (second).
    set_aside : int
        Detected rows left out, since they fit a reference row that does not count.
    """

    name: str
    reference: Sequence[RowType]
    detected: Sequence[RowType]
    pairs: Association
    set_aside: int


def pair_frames(
    reference: Iterable[Frame],
    detected: Iterable[Frame],
    rows_of: Callable[[Frame], tuple[RowType, ...]],
    *,
    all_frames: bool,
    reference_name: str,
    detected_name: str,
) -> PairedFrames[RowType]:
    """Pair the frames of two runs by the names of their images.

    Parameters
    ----------
    reference, detected : iterable of Frame
        The runs.
    rows_of : callable
        Takes the rows to compare out of a frame.
    all_frames : bool
        Keep frames that only one run has: with no rows on the other side.
    reference_name, detected_name : str
        What errors call the runs.

    Returns
    -------
    PairedFrames
        In the order of the reference, then those of `detected` alone.

    Raises
    ------
    CompareError
        If an image has two frames in one run.
    """
    wanted = _rows_by_image(reference, rows_of, reference_name)
    found = _rows_by_image(detected, rows_of, detected_name)
    only_in_reference = tuple(name for name in wanted if name not in found)
    only_in_detected = tuple(name for name in found if name not in wanted)
    if all_frames:
        names = [*wanted, *only_in_detected]
    else:
        names = [name for name in wanted if name in found]
    return PairedFrames(
        frames=tuple((name, wanted.get(name, ()), found.get(name, ())) for name in names),
        only_in_reference=only_in_reference,
        only_in_detected=only_in_detected,
    )


def match_rows(
    name: str,
    reference: Sequence[RowType],
    detected: Sequence[RowType],
    pair_up: Callable[[Sequence[RowType], Sequence[RowType]], Association],
    *,
    only_identified: bool,
    optional: Sequence[RowType] = (),
) -> FrameMatch[RowType]:
    """Match the rows of one frame one to one.

    Parameters
    ----------
    name : str
        The image.
    reference, detected : sequence of rows
        Its rows.
    pair_up : callable
        Associates reference with detected rows.
    only_identified : bool
        Count only reference rows that have an ID. Detected rows that fit one without, and none of
        the others, are set aside.
    optional : sequence of rows
        What may be detected but need not be: detected rows that fit one of these, and no reference
        row, are set aside, too.

    Returns
    -------
    FrameMatch
        The rows that count, and their pairs.
    """
    counted = [row for row in reference if row.identified or not only_identified]
    uncounted = [row for row in reference if not row.identified and only_identified]
    uncounted += optional
    pairs = pair_up(counted, detected)
    set_aside = 0
    if uncounted:
        alone = [detected[i] for i in pairs.second_alone]
        aside = pair_up(uncounted, alone)
        set_aside = len(aside.second)
        kept = sorted([*pairs.second, *pairs.second_alone[aside.second_alone]])
        detected = [detected[i] for i in kept]
        pairs = pair_up(counted, detected)
    return FrameMatch(name, counted, detected, pairs, set_aside)


def shown_name(image: str) -> str:
    """An image's name as errors quote it."""
    return repr(image[:_LONGEST_SHOWN_NAME])


def _rows_by_image(
    frames: Iterable[Frame], rows_of: Callable[[Frame], tuple[RowType, ...]], name: str
) -> dict[str, tuple[RowType, ...]]:
    rows: dict[str, tuple[RowType, ...]] = {}
    for frame in frames:
        image = image_name(frame.step.prefix)
        if image in rows:
            raise CompareError(f"{name}: two frames of image {shown_name(image)}: expected one")
        rows[image] = rows_of(frame)
    return rows
