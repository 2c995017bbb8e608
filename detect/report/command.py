"""The command ``detect report``: files of rows in, one page out."""

from __future__ import annotations

from detect.drawing.frame import draw_rows
from detect.errors import DetectError, FrameError
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
    from detect import __version__

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

    page = report_page(inputs, __version__, options.worst, picture_of)
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


def _picture(inputs: ReportInputs, prefix: str) -> Picture:
    """The picture of a frame as JPEG; or why there is none."""
    import cv2

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
