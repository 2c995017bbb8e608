"""The command ``detect draw``: rows from files drawn into the images."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from detect.drawing.frame import draw_candidates, draw_rows, draw_tracks, png_of, processed
from detect.errors import DetectError, FrameError
from detect.options import Draw
from detect.row_files import RunRows, open_rows
from detect.runs.frame import detect_batch, vertical_table_of
from detect.runs.plan import FramePlan, FrameTask
from detect.sources.grey_images import read_image
from detect.sources.image_files import demand_pictures, picture_name
from detect.sources.interface import ImageRun, Run, RunFrame, SomeFrames
from detect.sources.opening import demand_recording, open_source
from detect.terminal import progress_bar, report_failures
from redetect.array_types import ByteArray, GreyImage
from redetect.messages import counted
from redetect.storage import demand_place, write_bytes
from redetect.storage.images import quiet_opencv

Video = Callable[[ByteArray], None]
_FPS = 10.0  #: Frames per second of a video, by default.


def perform(options: Draw) -> int:
    """Execute the command; returns the exit code."""
    if options.output is None and options.video is None:
        raise DetectError("no output: expected a folder (-o) or a file (--video)")
    if options.video is None and options.fps is not None:
        raise DetectError("--fps: expected a video beside it: --video FILE")
    demand_recording(options.run)
    run = open_source(options.run, options.camera, options.source)
    run = replace(run, frames=SomeFrames(run.frames, every=options.every))
    rows = open_rows(run, options.files)
    if not isinstance(run, Run) and set(rows.detected) != {"markers"}:
        raise DetectError(
            f"{options.run}: no calibration: expected a .cam file in it, or one named by --camera; "
            "without one, only markers can be drawn"
        )
    if options.video is not None:
        demand_place(options.video, overwrite=options.force)
    if options.output is not None:
        demand_pictures(run.frames, options.output, overwrite=options.force)
    force, path, fps = options.force, options.video, options.fps or _FPS
    with nullcontext() if path is None else mp4(path, fps, overwrite=force) as video:
        drawn, blank, failures = draw_run(run, rows, options.output, video=video, overwrite=force)
    for where in (options.output, options.video):
        if where is not None:
            some = f"; {counted(blank, 'frame')} without rows" if blank else ""
            print(f"{where}: {counted(drawn, 'picture')} of {', '.join(rows.detected)}{some}")
    return report_failures(len(failures), failures)


def draw_run(
    run: ImageRun,
    rows: RunRows,
    folder: Path | None,
    plan: FramePlan | None = None,
    *,
    video: Video | None = None,
    overwrite: bool,
) -> tuple[int, int, list[str]]:
    """Draw rows into the images of a run, to PNG files in a folder, and to a video.

    With the plan of their detection, verticals are drawn as tracks, and markers with the rejected
    candidates. Returns the numbers of pictures and of those without rows, and why frames have none.
    """
    written = set[Path]()
    drawn, blank, failures = 0, 0, list[str]()
    projection = rows.projection(run.camera) if isinstance(run, Run) else None
    with progress_bar("pictures", run.frames.expected) as advance:
        for frame in run.frames:
            try:
                image = read_image(frame, None if projection is None else projection.camera)
            except FrameError as error:
                failures.append(str(error))
            else:
                prefix = frame.step.prefix
                name = picture_name(prefix)
                image_rows = rows.of(prefix)
                picture = draw_rows(image, projection, image_rows, name)
                if plan is not None:
                    picture = _with_rejected(picture, image, frame, plan)
                if folder is not None:
                    place = folder / f"{name}.png"
                    # Several steps may name one image.
                    write_bytes(place, png_of(picture), overwrite=overwrite or place in written)
                    written.add(place)
                if video is not None:
                    video(picture)
                drawn, blank = drawn + 1, blank + (not processed(image_rows))
            advance()
    return drawn, blank, failures


def _with_rejected(
    picture: ByteArray, image: GreyImage, frame: RunFrame, plan: FramePlan
) -> ByteArray:
    """All tracks instead of the verticals, rejected ones included; rejected markers as well."""
    (found,) = detect_batch([FrameTask(frame)], plan)
    if found.lines is not None and plan.camera is not None:
        picture = draw_tracks(image, vertical_table_of(plan.camera), found.lines)
    if found.markers is None:
        return picture
    return draw_candidates(picture, found.markers, picture.shape[1] // image.shape[1])


@contextmanager
def mp4(path: Path, fps: float, *, overwrite: bool) -> Iterator[Video]:
    """A video file, written once it is complete; yields a function that adds a picture.

    Raises DetectError if OpenCV cannot write such videos, or pictures differ in size, and OSError
    if there is no space for the video.
    """
    writer = cv2.VideoWriter()
    size: tuple[int, int] | None = None
    count = 0

    with tempfile.TemporaryDirectory() as folder, quiet_opencv():
        raw = Path(folder) / "video.mp4"

        def add(picture: ByteArray) -> None:
            nonlocal size, count
            # The encoder needs even numbers of rows and columns.
            height, width = picture.shape[:2]
            even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            even_size = (even.shape[1], even.shape[0])
            if size is None:
                size = even_size
                writer.open(str(raw), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
                if not writer.isOpened():
                    raise DetectError(
                        f"{path}: this OpenCV cannot write MP4 videos of {fps:g} frames per "
                        "second: expected another --fps, or -o and a folder"
                    )
            if even_size != size:
                raise DetectError(f"{path}: pictures differ in size: expected one size for a video")
            writer.write(even)
            count += 1

        try:
            yield add
        finally:
            writer.release()
        if size is None:
            raise DetectError(f"{path}: no pictures: expected at least one for a video")
        # OpenCV does not say whether it could write.
        if cv2.VideoCapture(str(raw)).get(cv2.CAP_PROP_FRAME_COUNT) != count:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(raw))
        write_bytes(path, raw.read_bytes(), overwrite=overwrite)
