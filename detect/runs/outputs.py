"""The files that a run is written to: each its kind, its place, its head, its rows."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from detect.run import ImageRun
from detect.runs.conduct import Conduct
from detect.runs.frame import FramePlan
from detect.sources.times import TIMES_HEAD
from landmarks import format_head

#: Endings of files of landmarks.
LANDMARK_SUFFIXES = frozenset({".circles", ".lines", ".markers"})

#: In the head of files whose positions are levelled, or corrected for the tilt.
LEVEL = "level robot frame"
LEVELLED = "corrected for the tilt of the frames that have one"

#: The kind of the log (`detect.runs.run_log`).
LOG = "log"
#: Files that a second pass makes from those of the first one (`detect.runs.level_run`).
LATE_KINDS = LEVEL_TILT, LEVEL_CIRCLES = "level tilt", "level circles"

_ROBOT = "Robot frame: origin on the floor, X left, Y backward (forward is -Y), metres, radians."
_STEP = "STEP <image> <dX> <dY> <dPhi> <cXX> <cXY> <cYY> <cXPhi> <cYPhi> <cPhiPhi>"
_TILT_ROWS = (
    "TILT <image> <pitch> <roll> <cPP> <cPR> <cRR> <lines>",
    "  rotation vector (pitch, roll, 0) about the robot's X (left) and Y (backward), radians:",
    "  it turns directions measured with the calibrated mounting level; its covariance;",
)


@dataclass(frozen=True)
class Output:
    """A file that a run is written to.

    Attributes
    ----------
    path : path
    kind : str
        Which of `FrameRows.rows` go into it: of a kind that they do not have, none do.
    head, tail : bytes
        Text before and after the rows of all frames.
    between : bytes
        Text between the rows of two frames.
    crlf : bool
        Whether rows end with CR and LF, as in the data set's own files.
    placed : bool
        Whether it is a result; else it is temporary and removed when others were made from it.
    """

    path: Path
    kind: str
    head: bytes = b""
    tail: bytes = b""
    between: bytes = b""
    crlf: bool = False
    placed: bool = True

    def ended(self, rows: bytes) -> bytes:
        """Rows with the ends that lines have in this file."""
        return rows.replace(b"\n", b"\r\n") if self.crlf else rows


def outputs_of(
    run: ImageRun, plan: FramePlan, places: Mapping[str, Path], conduct: Conduct, *, levelled: bool
) -> list[Output]:
    """The files of a run.

    Parameters
    ----------
    run : ImageRun
        The run.
    plan : FramePlan
        What is detected in it.
    places : mapping
        Where files of each kind go: "circles", "lines", "tilt", "markers", "json".
    conduct : Conduct
        Says the version and how lines end.
    levelled : bool
        Whether discs are corrected for the tilt.
    """
    outputs = []
    crlf, by_run = conduct.crlf, plan.levelling == "run" and plan.lines is not None
    if "json" in places:
        outputs.append(_json_file(places["json"], plan, conduct.version))
    if "tilt" in places:
        path = frames_tilt_place(places["tilt"]) if by_run else places["tilt"]
        outputs.append(Output(path, "tilt", _head(_tilt_text(conduct.version, by_run=by_run))))
    if "lines" in places:
        head = _head(_lines_text(run, plan, conduct.version), crlf=crlf)
        outputs.append(Output(places["lines"], "lines", head, crlf=crlf))
    if "circles" in places:
        path = places["circles"]
        head = _head(_circles_text(run, plan, conduct.version, levelled=levelled), crlf=crlf)
        if by_run:
            raw = path.with_name(f"{path.stem}.raw.circles")
            outputs.append(Output(raw, "circles", head, placed=False))
            tilt_head = _head(_level_tilt_text(conduct.version))
            outputs.append(Output(places["tilt"], LEVEL_TILT, tilt_head))
        kind = LEVEL_CIRCLES if by_run else "circles"
        outputs.append(Output(path, kind, head, crlf=crlf))
    if "markers" in places:
        head = _head(_markers_text(run, plan, conduct.version))
        outputs.append(Output(places["markers"], "markers", head))
    if run.has_times:
        place = _times_place([output.path for output in outputs])
        outputs.append(Output(place, "times", _head([TIMES_HEAD])))
    return outputs


def frames_tilt_place(tilt: Path) -> Path:
    """The file of the single frames' tilts beside that of the tilts that discs are levelled by."""
    return tilt.with_name(f"{tilt.stem}.frames.tilt")


def _times_place(results: list[Path]) -> Path:
    """The file of the frames' times beside results.

    It is called like the file of landmarks, with ``.times`` behind; where there are several, like
    what they have in common: ``detected.circles.times``, but ``detected.times``.
    """
    landmarks = [path for path in results if path.suffix in LANDMARK_SUFFIXES]
    path = landmarks[0] if landmarks else results[-1]
    return path.with_name(f"{path.stem if len(landmarks) > 1 else path.name}.times")


def _circles_text(run: ImageRun, plan: FramePlan, version: str, *, levelled: bool) -> list[str]:
    assert plan.circles is not None
    refined = plan.circles.refine
    position = "fitted to the grey values" if refined else "that of the pixel in the middle"
    level = f"  positions are {LEVELLED}: # levelled <pitch> <roll>"
    return [
        f"Discs on the floor, detected by redetect {version}.",
        *(_ROBOT, _STEP, _odometry(run)),
        "LANDMARK_C <pX> <pY> <quality> <cXX> <cXY> <cYY> <ID>",
        f"  position {position}; quality is Otsu's, 0 to 1; ID -1: unknown",
        *([level] if levelled else []),
        *_made_with(plan, plan.circles),
    ]


def _lines_text(run: ImageRun, plan: FramePlan, version: str) -> list[str]:
    assert plan.lines is not None
    sign = "compensated for the tilt"
    if plan.lines.alpha == "published":
        sign += ", with the data set's own sign"
    return [
        f"Verticals of the building, detected by redetect {version}.",
        *(_ROBOT, _STEP, _odometry(run)),
        "LANDMARK_L <xTop> <yTop> <xBottom> <yBottom> <alpha> <beta> <quality> <sigma> <ID>",
        "  ends: undistorted normalised coordinates; beta: inclination of the plane's normal",
        f"  alpha: bearing (0 forward, positive to the left), {sign}; sigma: its deviation",
        *_made_with(plan, plan.lines),
    ]


def _markers_text(run: ImageRun, plan: FramePlan, version: str) -> list[str]:
    return [
        f"Square markers, detected by redetect {version}.",
        *(_STEP, _odometry(run)),
        "LANDMARK_M <dictionary> <ID> <quality>, and for each corner <u> <v> <cUU> <cUV> <cVV>",
        "  corners top left, top right, bottom right, bottom left of the marker as printed;",
        "  pixels of the original image, the top left pixel's centre is 0 0; quality: 1 is perfect",
        *_made_with(plan, plan.markers),
    ]


def _tilt_text(version: str, *, by_run: bool) -> list[str]:
    outlines = "TILT_D <image> ... <discs>: the same by the outlines of the frame's discs"
    return [
        f"Pitch and roll of each frame from the building's verticals, by redetect {version}.",
        *_TILT_ROWS,
        "  and the number of verticals that agree with it",
        "NOTILT <image> <lines>: too few lines agree",
        *([outlines] if by_run else []),
    ]


def _level_tilt_text(version: str) -> list[str]:
    return [
        f"Pitch and roll that the discs of each frame were levelled by, by redetect {version}:",
        "  the constant lean of the run and the frame's estimated deviation from it",
        *_TILT_ROWS,
        "  and the number of verticals that agree with the tilt of the frame by itself",
        "NOTILT <image> <lines>: its discs are as they were seen",
    ]


def _json_file(path: Path, plan: FramePlan, version: str) -> Output:
    """The text that `json.dumps` with an indent of 1 gives."""
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


def _odometry(run: ImageRun) -> str:
    source = run.odometry.name if run.odometry is not None else "none: the steps are zeros"
    return f"  odometry: {source}; the image was taken after the step"


def _made_with(plan: FramePlan, settings: Any) -> tuple[str, str]:
    camera = "none: edges straight in the image" if plan.camera is None else str(plan.camera)
    values = " ".join(
        f"{name}={str(value).replace(' ', '')}"
        for name, value in dataclasses.asdict(settings).items()
    )
    return f"camera {camera}", f"settings {values}"


def _head(lines: Iterable[str], *, crlf: bool = False) -> bytes:
    return format_head("\n".join(lines), "\r\n" if crlf else "\n")
