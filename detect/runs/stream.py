"""The way of a run: frames in, files out, neither ever in memory as a whole.

    frames of the run  ->  tasks  ->  workers (`detect.runs.dispatch`)  ->  rows in order  ->  files

The files are the same bytes whoever worked on the frames; they appear together at the end, or not
at all.
"""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Literal, Protocol

from detect.discs.identity import MappedDisc
from detect.run import ImageRun
from detect.runs.conduct import PLAIN, Conduct
from detect.runs.dispatch import Workers, detect_chunks
from detect.runs.frame import FramePlan, tables_of
from detect.runs.frame_rows import FrameRows, FrameTask, KnownRows
from detect.runs.garbage import settled
from detect.runs.resume import RunFiles, SecondPass
from detect.runs.workers import local_workers, pixels_of
from detect.sources.times import TIMES_HEAD
from landmarks import CircleLandmark, FrameTilt, LineLandmark, format_head
from storage import write_whole

#: Endings of files of landmarks.
LANDMARK_SUFFIXES = frozenset({".circles", ".lines", ".markers"})

#: So many failures are kept word for word.
KEPT_FAILURES = 100

_TASKS_AHEAD = 128


class TiltSource(Protocol):
    """Tilts by image prefix: a dict, or a file that is looked into."""

    def get(self, prefix: str, /) -> FrameTilt | None: ...


class LineSource(Protocol):
    """Lines with IDs by image prefix: a dict, or a file that is looked into."""

    def get(self, prefix: str, /) -> Sequence[LineLandmark] | None: ...


class DiscSource(Protocol):
    """Rows of discs with IDs by image prefix: a dict, or a file that is looked into."""

    def get(self, prefix: str, /) -> Sequence[CircleLandmark] | None: ...


class MapSource(Protocol):
    """Discs that a map and a path let each frame see, by image prefix."""

    def get(self, prefix: str, /) -> Sequence[MappedDisc] | None: ...


@dataclass(frozen=True)
class IdSources:
    """Where the IDs of a run's rows come from.

    Attributes
    ----------
    lines : mapping, optional
        Lines with IDs by image prefix: carried over where the match is unambiguous.
    discs : mapping, optional
        Discs with IDs by image prefix.
    mapped : mapping, optional
        Discs of a map by image prefix, for rows that `discs` knows nothing of.
    """

    lines: LineSource | None = None
    discs: DiscSource | None = None
    mapped: MapSource | None = None

    def of(self, prefix: str) -> KnownRows:
        """What is known of a frame."""
        return KnownRows(
            lines=None if self.lines is None else tuple(self.lines.get(prefix) or ()),
            discs=None if self.discs is None else tuple(self.discs.get(prefix) or ()),
            mapped=None if self.mapped is None else tuple(self.mapped.get(prefix) or ()),
        )


@dataclass(frozen=True)
class Output:
    """A file that a run is written to.

    Attributes
    ----------
    path : path
    part : str
        Which part of `FrameRows` goes into it; "late": none, a second pass fills it.
    head, tail : bytes
        What stands before and after the rows of all frames.
    between : bytes
        What stands between those of two frames.
    crlf : bool
        Whether rows end with CR and LF, as in the data set's own files.
    placed : bool
        Whether it is a result; else others are made of it, and it goes when they are there.
    """

    path: Path
    part: Literal["circles", "lines", "tilt", "markers", "json", "times", "late"]
    head: bytes = b""
    tail: bytes = b""
    between: bytes = b""
    crlf: bool = False
    placed: bool = True


@dataclass
class RunSummary:
    """What came of a run.

    Attributes
    ----------
    frames, discs, lines, tilts, markers : int
        Frames looked at, discs and lines found in them, frames whose tilt could be told, and
        markers found.
    rejected : Counter
        How many candidates for markers were rejected, by cause.
    failed : int
        Frames that could not be worked on.
    failures : list of str
        A line for each of the first `KEPT_FAILURES` of them.
    images_without_step : int
        Images that are no part of the run: the odometry knows nothing of them.
    """

    frames: int = 0
    discs: int = 0
    lines: int = 0
    tilts: int = 0
    markers: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    failed: int = 0
    failures: list[str] = field(default_factory=list)
    images_without_step: int = 0

    def add(self, rows: FrameRows) -> None:
        """Count a frame."""
        self.frames += 1
        self.discs += rows.disc_count
        self.lines += rows.line_count
        self.tilts += rows.has_tilt
        self.markers += rows.marker_count
        if rows.rejected:
            self.rejected.update(dict(rows.rejected))
        if rows.error is not None:
            self.failed += 1
            if len(self.failures) < KEPT_FAILURES:
                self.failures.append(rows.error)


def detect_run(
    run: ImageRun,
    plan: FramePlan,
    outputs: Sequence[Output],
    *,
    overwrite: bool = False,
    tilts: TiltSource | None = None,
    ids: IdSources | None = None,
    pictures: Path | None = None,
    workers: Workers | None = None,
    on_progress: Callable[[], None] | None = None,
    conduct: Conduct = PLAIN,
    second_pass: SecondPass | None = None,
) -> RunSummary:
    """Do with every frame of a run what a plan says, and write what comes of it.

    Parameters
    ----------
    run : ImageRun
        The run.
    plan : FramePlan
        What to look for.
    outputs : sequence of Output
        The files to write. Where the frames' times are known, they go beside them.
    overwrite : bool
        Whether existing files may be replaced.
    tilts : mapping, optional
        Tilts by image prefix, for frames whose verticals are not looked for.
    ids : IdSources, optional
        Where the rows' IDs come from.
    pictures : path, optional
        Folder for what the plan has drawn.
    workers : Workers, optional
        Who does the work; by default this process (see `detect.runs.workers`).
    on_progress : callable, optional
        Called once after every frame.
    conduct : Conduct
        Whether there are a log and a journal, how bad frames are met, and whether an unfinished run
        is resumed.
    second_pass : callable, optional
        Makes the files of the part "late" of the others, when all frames are done.

    Returns
    -------
    RunSummary

    Raises
    ------
    lut.TableError
        If there can be no table for the camera.
    storage.OutputExistsError
        If an output exists and must not be replaced.
    WorkerError
        If there is nobody to do the work.
    DetectError
        If another run is writing the same files, or a frame fails where every frame is demanded.
    """
    if workers is None:
        large = pictures is not None or run.frames.ships_images
        workers = local_workers(1, pictures=large, frame_pixels=pixels_of(plan.camera))
    if not workers.tell_of_tables:
        tables_of(plan)  # whatever is wrong with them is wrong with every frame
    summary = RunSummary()
    if run.has_times:
        outputs = [*outputs, times_file([output.path for output in outputs])]
    with ExitStack() as stack:
        stack.enter_context(settled())
        files = stack.enter_context(RunFiles(outputs, plan, conduct, overwrite=overwrite))
        tasks = stack.enter_context(closing(_tasks(run, tilts, ids)))
        for rows in files.kept(tasks):
            summary.add(rows)
            if on_progress is not None:
                on_progress()
        left = files.left(tasks)
        if not run.frames.ships_images:
            left = stack.enter_context(closing(_ahead(left)))
        found = stack.enter_context(closing(detect_chunks(left, plan, workers)))
        for chunk in found:
            # A frame whose picture is there is noted before the next picture is.
            for frames in [chunk] if pictures is None else [[rows] for rows in chunk]:
                if pictures is not None:
                    redraw = overwrite or files.may_be_drawn_already
                    _write_pictures(frames, pictures, overwrite=redraw)
                files.add(frames)
                for rows in frames:
                    summary.add(rows)
                    if on_progress is not None:
                        on_progress()
        summary.images_without_step = run.images_without_step
        files.finish(summary, second_pass)
    return summary


def times_file(results: Sequence[Path]) -> Output:
    """The file of the frames' times that stands beside results.

    It is called like the file of landmarks, with ``.times`` behind; where there are several, like
    what they have in common: ``detected.circles.times``, but ``detected.times``.
    """
    landmarks = [path for path in results if path.suffix in LANDMARK_SUFFIXES]
    path = landmarks[0] if landmarks else results[-1]
    name = f"{path.stem if len(landmarks) > 1 else path.name}.times"
    return Output(path.with_name(name), "times", format_head(TIMES_HEAD))


def json_file(path: Path, plan: FramePlan, version: str) -> Output:
    """The file of the discs as JSON: what `json.dumps` with an indent of 1 gives."""
    assert plan.circles is not None
    assert plan.camera is not None
    document = {
        "version": version,
        "settings": dataclasses.asdict(plan.circles),
        "camera": plan.camera.content_hash,
        "frames": [],
    }
    head, tail = json.dumps(document, indent=1).rsplit("]", 1)
    return Output(path, "json", head.encode(), f"\n ]{tail}\n".encode(), b",")


def _ahead(tasks: Iterable[FrameTask]) -> Generator[FrameTask, None, None]:
    """The same tasks, made some at a time: what makes them is in the processor's caches then."""
    source = iter(tasks)
    while batch := tuple(islice(source, _TASKS_AHEAD)):
        yield from batch


def _write_pictures(frames: Sequence[FrameRows], folder: Path, *, overwrite: bool) -> None:
    for rows in frames:
        for name, picture in rows.pictures:
            with write_whole(folder / name, overwrite=overwrite) as stream:
                stream.write(picture)


def _tasks(
    run: ImageRun, tilts: TiltSource | None, ids: IdSources | None
) -> Generator[FrameTask, None, None]:
    with closing(iter(run.frames)) as frames:
        for frame in frames:
            prefix = frame.step.prefix
            yield FrameTask(
                frame,
                tilt=None if tilts is None else tilts.get(prefix),
                known=None if ids is None else ids.of(prefix),
            )
