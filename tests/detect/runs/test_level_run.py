"""The second pass over a run: rows go in as seen, and come out level."""

from __future__ import annotations

import io

import numpy as np
import pytest

from camera import Camera
from detect.projection import level_positions
from detect.runs.level_run import level_run
from detect.runs.plan import RunSummary
from detect.settings import LEAST_FRAMES, CircleSettings
from redetect.landmarks.files import frames_of_rows, parse_rows

LEAN = -0.04, 0.01
STEP = "STEP {} 0.0 0.0 0.0 1e-6 0.0 1e-6 0.0 0.0 1e-6\n"
DISC = "LANDMARK_C 0.5 -2.5 0.9 1e-06 0 1e-06 7\n"


NO_ERRORS = CircleSettings(calibration_px=0.0, tilt_sigma_deg=0.0)


def level(camera: Camera, frames: int) -> dict[str, bytes]:
    rng = np.random.default_rng(5)
    seen = []
    for k in range(frames):
        pitch, roll = np.array(LEAN) + 1e-4 * rng.standard_normal(2)
        tilt = f"TILT {k} {pitch:.6f} {roll:.6f} 1e-8 0 1e-8 9\n" if k else "NOTILT 0 2\n"
        seen.append({"tilt": tilt, "circles": STEP.format(k) + DISC})
    written = list(level_run(camera, NO_ERRORS, lambda: seen, RunSummary()))
    return {
        kind: "".join(rows[kind] for rows in written).encode() for kind in ("run tilt", "circles")
    }


def test_discs_come_out_level_also_in_a_frame_without_verticals(published_camera: Camera) -> None:
    written = level(published_camera, 3 * LEAST_FRAMES)

    expected = level_positions(published_camera, np.array([[0.5, -2.5]]), LEAN)[0]
    frames = list(frames_of_rows(parse_rows(io.BytesIO(written["circles"]))))
    assert len(frames) == 3 * LEAST_FRAMES
    for frame in frames:
        (disc,) = frame.circles
        assert (disc.px, disc.py) == pytest.approx(expected, abs=2e-3)
        assert disc.ids == (7,)
        assert frame.levelled_by == pytest.approx(LEAN, abs=5e-4)
    assert written["run tilt"].count(b"TILT ") == 3 * LEAST_FRAMES
    assert b"NOTILT" not in written["run tilt"]


def test_few_frames_are_levelled_each_by_itself(published_camera: Camera) -> None:
    written = level(published_camera, 4)

    first, *others = frames_of_rows(parse_rows(io.BytesIO(written["circles"])))
    assert first.levelled_by is None
    assert (first.circles[0].px, first.circles[0].py) == (0.5, -2.5)
    assert all(frame.levelled_by is not None for frame in others)
    assert written["run tilt"].startswith(b"NOTILT 0 2\n")
    # Blanks other than ASCII's are part of a name.
    seen = {"tilt": "NOTILT im\u00a0age 2\n", "circles": STEP.format("im\u00a0age") + DISC}
    (alone,) = level_run(published_camera, NO_ERRORS, lambda: [seen], RunSummary())
    assert alone["circles"] == seen["circles"]
