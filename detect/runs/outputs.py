"""The output files of a run, each with kind, path, head and rows; and the log.

The log, ``<output>.log.json``, contains the program and its settings, the failed frames with
reasons, and the number of detections. The same run writes the same bytes, whatever the workers.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from camera import Camera
from detect.errors import EXIT_FRAMES_FAILED
from detect.projection import Tilt
from detect.runs.plan import FramePlan, Job, RunSummary
from detect.settings import CircleSettings
from detect.sources.interface import ImageRun
from redetect import __version__
from redetect.json_text import json_text
from redetect.landmarks import format_head
from redetect.landmarks.files import LEVELLED
from redetect.landmarks.frame_files import TIMES_HEAD

#: The kind of the tilts that the second pass writes (`detect.runs.level_run`).
RUN_TILT = "run tilt"

_ROBOT = "Robot frame: origin on the floor, X left, Y backward (forward is -Y), metres, radians."
_STEP = "STEP <image> <dX> <dY> <dPhi> <cXX> <cXY> <cYY> <cXPhi> <cYPhi> <cPhiPhi>"
_TILT_ROWS = (
    "TILT <image> <pitch> <roll> <cPP> <cPR> <cRR> <lines>",
    "  rotation vector (pitch, roll, 0) about the robot's X (left) and Y (backward), radians:",
    "  it turns directions measured with the calibrated mounting level; its covariance;",
)
_TILT_TEXT = (
    f"Pitch and roll of each frame from the building's verticals, by redetect {__version__}.",
    *_TILT_ROWS,
    "  and the number of verticals that agree with it",
    "NOTILT <image> <lines>: too few lines agree",
)
_OUTLINES_TEXT = "TILT_D <image> ... <discs>: the same by the outlines of the frame's discs"
_RUN_TILT_TEXT = (
    f"Pitch and roll that the discs of each frame were levelled by, by redetect {__version__}:",
    "  the constant lean of the run and the frame's estimated deviation from it",
    *_TILT_ROWS,
    "  and the number of verticals that agree with the tilt of the frame by itself",
    "NOTILT <image> <lines>: its discs are as they were seen",
)
_COMMON = "  covariances include the calibration's ({}): its errors are the same in all"


@dataclass(frozen=True)
class Output:
    """A file of a run: `FrameRows.rows` of a kind between head and tail, with separators."""

    path: Path
    kind: str
    head: str = ""
    tail: str = ""
    between: str = ""
    crlf: bool = False

    def encoded(self, text: str) -> bytes:
        """A part of the content, as bytes."""
        text = text.replace("\n", "\r\n") if self.crlf else text
        return text.encode("utf-8", "surrogateescape")


def outputs_of(job: Job) -> list[Output]:
    """The files of a run, except its log."""
    run, plan, paths = job.run, job.plan, job.outputs
    outputs = []
    by_run = plan.levelling == "run" and plan.lines is not None

    def add(path: Path, kind: str, *head: str, crlf: bool = False) -> None:
        text = format_head("\n".join(head)).decode("utf-8", "surrogateescape")
        outputs.append(Output(path, kind, text, crlf=crlf))

    if "json" in paths:
        outputs.append(_json_file(paths["json"], plan))
    if "tilt" in paths:
        path = frames_tilt_place(paths["tilt"]) if by_run else paths["tilt"]
        add(path, "tilt", *_TILT_TEXT, *([_OUTLINES_TEXT] if by_run else []))
    if "lines" in paths:
        add(paths["lines"], "lines", *_lines_text(run, plan), crlf=job.crlf)
    if "tilt" in paths and "circles" in paths and by_run:
        add(paths["tilt"], RUN_TILT, *_RUN_TILT_TEXT)
    if "circles" in paths:
        add(paths["circles"], "circles", *_circles_text(job), crlf=job.crlf)
    if "markers" in paths:
        add(paths["markers"], "markers", *_markers_text(run, plan), crlf=job.crlf)
    if run.has_times:
        add(job.beside(".times"), "times", TIMES_HEAD)
    return outputs


def frames_tilt_place(tilt: Path) -> Path:
    """The file of the single frames' tilts, beside that of the tilts used for levelling."""
    return tilt.with_name(f"{tilt.stem}.frames.tilt")


def _circles_text(job: Job) -> list[str]:
    plan = job.plan
    assert plan.circles is not None
    how = "fitted to the grey values" if plan.circles.refine else "that of the pixel in the middle"
    levelled = plan.levelling != "none" and (plan.lines or job.known.tilts is not None)
    return [
        f"Discs on the floor, detected by redetect {__version__}.",
        *(_ROBOT, _STEP, *_source_text(job.run)),
        "LANDMARK_C <pX> <pY> <quality> <cXX> <cXY> <cYY> <ID>",
        f"  position {how}; quality is Otsu's, 0 to 1; ID -1: unknown",
        *([f"  positions are {LEVELLED}: # levelled <pitch> <roll>"] if levelled else []),
        *([f"  {lean_sentence(plan.lean)}"] if plan.lean else []),
        *_calibration_text(plan.camera, plan.circles),
        *_made_with(plan, plan.circles),
    ]


def lean_sentence(lean: Tilt) -> str:
    """A sentence on the camera's lean in the search for discs."""
    pitch, roll = map(math.degrees, lean)
    return (
        f"discs are searched as the camera leans from its calibration: pitch {pitch:.1f}, "
        f"roll {roll:.1f} degrees"
    )


def _calibration_text(camera: Camera | None, circles: CircleSettings) -> list[str]:
    if camera is None or not circles.refine:
        return []
    if camera.covariance is not None:
        return [_COMMON.format("key covariance")] if any(camera.covariance) else []
    return [_COMMON.format(f"{circles.calibration_px:g} px")] if circles.calibration_px else []


def _lines_text(run: ImageRun, plan: FramePlan) -> list[str]:
    assert plan.lines is not None
    sign = "compensated for the tilt"
    if plan.lines.alpha == "published":
        sign += ", with the data set's own sign"
    return [
        f"Verticals of the building, detected by redetect {__version__}.",
        *(_ROBOT, _STEP, *_source_text(run)),
        "LANDMARK_L <xTop> <yTop> <xBottom> <yBottom> <alpha> <beta> <quality> <sigma> <ID>",
        "  ends: undistorted normalised coordinates; beta: inclination of the plane's normal",
        f"  alpha: bearing (0 forward, positive to the left), {sign}; sigma: its deviation",
        *_made_with(plan, plan.lines),
    ]


def _markers_text(run: ImageRun, plan: FramePlan) -> list[str]:
    return [
        f"Square markers, detected by redetect {__version__}.",
        *(_STEP, *_source_text(run)),
        "LANDMARK_M <dictionary> <ID> <quality>, and for each corner <u> <v> <cUU> <cUV> <cVV>",
        "  corners top left, top right, bottom right, bottom left of the marker as printed;",
        "  pixels of the original image, the top left pixel's centre is 0 0; quality: 1 is perfect",
        *_made_with(plan, plan.markers),
    ]


def _json_file(path: Path, plan: FramePlan) -> Output:
    """A JSON file as `json_text` would write it."""
    assert plan.circles is not None
    assert plan.camera is not None
    document = {
        "version": __version__,
        "settings": plan.circles,
        "camera": plan.camera.content_hash,
        "frames": [],
    }
    head, tail = json_text(document).rsplit("]", 1)
    return Output(path, "json", head, f"\n ]{tail}\n", ",")


def _source_text(run: ImageRun) -> list[str]:
    source = run.odometry.name if run.odometry is not None else "none: the steps are zeros"
    odometry = f"  odometry: {source}; the image was taken after the step"
    return [odometry, f"  {depth_sentence(run.bit_depth)}"] if run.bit_depth else [odometry]


def depth_sentence(bit_depth: int) -> str:
    """A sentence on the scale of images whose values are stored in 16 bits."""
    return f"of values stored in 16 bits, the 8 highest of {bit_depth} bits are used (--bit-depth)"


def _made_with(plan: FramePlan, settings: Any) -> tuple[str, str]:
    camera = "none: edges straight in the image" if plan.camera is None else str(plan.camera)
    values = " ".join(
        f"{name}={str(value).replace(' ', '')}"
        for name, value in dataclasses.asdict(settings).items()
    )
    return f"camera {camera}", f"settings {values}"


# -- the log --------------------------------------------------------------------------------


def log_text(job: Job, summary: RunSummary, failures: Sequence[Mapping[str, object]]) -> str:
    """The content of a log; `failures` are those of frames."""
    plan = job.plan
    settings = {"circles": plan.circles, "lines": plan.lines, "markers": plan.markers}
    document = {
        "program": "redetect",
        "version": __version__,
        "command": job.command,
        "camera": None if plan.camera is None else plan.camera.content_hash,
        "settings": {kind: values for kind, values in settings.items() if values},
        **({"lean_rad": plan.lean} if plan.lean else {}),
        **({"bit_depth": job.run.bit_depth} if job.run.bit_depth else {}),
        "failures": failures,
        "frames": summary.frames,
        "failed": summary.failed,
        "images_left_out": summary.images_left_out,
        "found": {kind: summary.found[kind] for kind in ("discs", "lines", "tilts", "markers")},
        "rejected": dict(sorted(summary.rejected.items())),
        "exit_code": EXIT_FRAMES_FAILED if summary.failed else 0,
    }
    return f"{json_text(document, limits=True)}\n"
