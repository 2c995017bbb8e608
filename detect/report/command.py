"""The command ``detect report``: files of rows in, one page out."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from detect import __version__
from detect.drawing.frame import draw_rows
from detect.errors import DetectError, FrameError
from detect.report.gallery import gallery
from detect.report.inputs import ReportInputs, gather
from detect.report.page import Picture, report_page
from detect.run import Run, RunFrame, read_image
from detect.settings import CircleSettings
from detect.sources.opening import demand_recording, open_source
from detect.viewing_options import Report
from storage import OutputExistsError, write_whole

_JPEG_QUALITY = 88


def perform(options: Report) -> int:
    """Carry the command out; returns the exit code."""
    if options.worst < 0:
        raise DetectError(f"worst is {options.worst}: expected 0 or more")
    demand_recording(options.run)
    run = open_source(options.run, options.camera, options.source)
    output = run.output("html") if options.output is None else options.output
    if output.exists() and not options.force:
        raise OutputExistsError(output)
    inputs = gather(run, options.files, options.gates, options.time_frames)

    def picture_of(prefix: str) -> Picture:
        return _picture(inputs, prefix)

    galleries = [
        (fate, *encoded)
        for fate in ("missed", "extra")
        if (encoded := _gallery(inputs, fate)) is not None
    ]
    page = report_page(inputs, __version__, options.worst, picture_of, galleries)
    with write_whole(output, overwrite=options.force) as stream:
        stream.write(page)
    held = [
        path.name
        for path in (inputs.files.reference_circles, inputs.files.reference_lines)
        if path is not None
    ]
    against = f" against {' and '.join(held)}" if held else ", no reference rows"
    print(f"{output}: {len(inputs.rows)} frames, {', '.join(inputs.files.detected)}{against}")
    return 0


def _gallery(inputs: ReportInputs, fate: str) -> tuple[bytes, int, int, int, int] | None:
    """Cut-outs of missed or extra discs as JPEG: content, width, height, how many, of how many."""
    frames = {frame.step.prefix: frame for frame in inputs.run.frames}
    camera = inputs.run.camera if isinstance(inputs.run, Run) else None

    def image_of(prefix: str) -> NDArray[np.uint8] | None:
        try:
            return read_image(frames[prefix], camera)
        except FrameError:
            return None

    found = gallery(inputs, fate, image_of)
    if found is None:
        return None
    picture, shown, count = found
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return encoded.tobytes(), picture.shape[1], picture.shape[0], shown, count


def _picture(inputs: ReportInputs, prefix: str) -> Picture:
    """The picture of a frame as JPEG; or why there is none."""
    run = inputs.run
    camera = run.camera if isinstance(run, Run) else None
    frame: RunFrame | None = next((f for f in run.frames if f.step.prefix == prefix), None)
    if frame is None:
        return "no such frame in the run"
    try:
        image = read_image(frame, camera)
    except FrameError as error:
        return str(error)
    head = inputs.files.heads.get("circles")
    settings = CircleSettings() if head is None else head.circle_settings
    rows = inputs.rows[inputs.names.index(prefix)]
    picture = draw_rows(image, camera, rows, settings, inputs.gate, inputs.line_gate)
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return encoded.tobytes(), picture.shape[1], picture.shape[0]
