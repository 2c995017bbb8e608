"""The detectors on images whose truth is known, scored by the scripts beside the data."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree
from tyro.conf import Positional

from detect.line_settings import PRESETS as LINE_PRESETS
from detect.line_settings import LineSettings
from detect.runs.plan import FramePlan, Job, Priors
from detect.runs.stream import detect_run
from detect.settings import CircleSettings, Polarity
from detect.sources.opening import open_run
from redetect.landmarks import FrameTilt, read_frames, read_tilts, squared_mahalanobis
from redetect.landmarks.arrays import circle_arrays
from tools.evaluation.figures import Figures, Study, StudyError, compared, print_figures
from tools.evaluation.tables import Table

Preset = Literal["default", "published", "report"]
#: Rows at most this far from a disc of a photograph have found it, as in the scorer.
_MATCH_M = 0.05
#: A line of the scorer's output, and the names of its numbers.
_LINE = re.compile(
    r"(\S+) +images +(\d+) discs +(\d+) recall +([\d.]+) +FP/img +([\d.]+) +err mm med +([\d.]+)"
)
_NAMES = ("images", "discs", "recall", "false", "median_mm")


def _detect(
    run: Path, places: dict[str, Path], known: Priors | None = None, **settings: Any
) -> None:
    """Detect a run's `circles` or `lines` with settings of theirs; failures go to stderr."""
    opened = open_run(run)
    job = Job(opened, FramePlan(opened.camera, **settings), places, known or Priors())
    for failure in detect_run(job).failures:
        print(failure, file=sys.stderr)


def _detect_lines(run: Path, settings: LineSettings, output: Path) -> dict[str, FrameTilt]:
    """Write a run's verticals; returns their tilts."""
    tilts = output.with_suffix(".tilt")
    _detect(run, {"lines": output, "tilt": tilts}, lines=settings)
    return read_tilts(tilts)


def _scored(script: Path, *arguments: object, folder: str | None = None) -> str:
    """The output of a scorer, which is also printed."""
    # A scorer may have a module named camera: in another folder it does not find ours.
    words = [sys.executable, str(script.resolve()), *map(str, arguments)]
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False, cwd=folder)
    print(done.stdout, end="", flush=True)
    if done.returncode != 0:
        raise StudyError(f"{script} ended with {done.returncode}")
    return done.stdout


@dataclass(frozen=True)
class Photographs(Study):
    """Detect the discs of every folder below DATA/dev and score them with DATA/evaluate.py."""

    data: Positional[Path] = Path("../shared/data/discs")  # Folder with `evaluate.py` and `dev`.

    def measured(self) -> Figures:
        normalised: list[float] = []
        with tempfile.TemporaryDirectory() as folder:
            files = []
            for truth in sorted(self.data.glob("dev/*/truth.json")):
                files.append(Path(folder) / f"{truth.parent.name}.circles")
                _detect(truth.parent, {"circles": files[-1]}, circles=CircleSettings())
                (frame,) = read_frames(files[-1])
                true = [(d["px"], d["py"]) for d in json.loads(truth.read_text())["discs"]]
                rows = circle_arrays(frame.circles)
                distance, nearest = cKDTree(true).query(rows.xy)
                off = rows.xy - np.array(true)[nearest]
                squared = squared_mahalanobis(off, rows.covariance)
                normalised += (squared[distance < _MATCH_M] / 2.0).tolist()
            text = _scored(self.data / "evaluate.py", "--circles", *files)
        print(f"normalised error^2 / dof {np.mean(normalised):.2f}")
        groups = {g: dict(zip(_NAMES, map(float, values))) for g, *values in _LINE.findall(text)}
        return {"found": len(normalised), "normalised": np.mean(normalised), **groups}


@dataclass(frozen=True)
class Buildings(Study):
    """Detect the verticals of every folder below DATA/dev and score them with DATA/evaluate.py."""

    data: Positional[Path] = Path("../shared/data/york")  # Folder with `evaluate.py` and `dev`.
    preset: Preset = "default"  # Of the line detector.

    def measured(self) -> Figures:
        with tempfile.TemporaryDirectory() as folder:
            files = []
            for run in sorted(path.parent for path in self.data.glob("dev/*/truth.json")):
                files.append(Path(folder) / f"{run.name}.lines")
                _detect(run, {"lines": files[-1]}, lines=LINE_PRESETS[self.preset])
            scores = Path(folder) / "scores.json"
            said = _scored(self.data / "evaluate.py", "--lines", *files, "--json", scores)
            (within,) = re.findall(r"< ?2 sigma ([.\d]+)", said)
            return {**json.loads(scores.read_text())["lines"], "within_2_sigma": float(within)}


@dataclass(frozen=True)
class Rendered(Study):
    """Detect a rendered run's light discs, its verticals and the tilt, and level the discs.

    Its evaluate.py scores the discs, the verticals, and the levelled discs.
    """

    run: Positional[Path] = Path("../shared/data/rendered/r1")  # `evaluate.py` is beside it.
    preset: Preset = "default"  # Of the line detector.
    polarity: Polarity = "light"  # Given to the disc detector.

    def measured(self) -> Figures:
        figures: dict[str, Any] = {}
        with tempfile.TemporaryDirectory() as folder:
            discs, lines, levelled = (
                Path(folder) / name for name in ("discs.circles", "lines.lines", "levelled.circles")
            )
            settings = CircleSettings(polarity=self.polarity)
            _detect(self.run, {"circles": discs}, circles=settings)
            tilts = _detect_lines(self.run, LINE_PRESETS[self.preset], lines)
            _detect(self.run, {"circles": levelled}, Priors(tilts=tilts), circles=settings)
            script = self.run.parent / "evaluate.py"
            for path in (discs, lines, levelled):
                print(path.name, flush=True)
                text = _scored(script, self.run.name, path, folder=folder)
                figures[path.stem] = json.loads(text)
        return {**figures, "tilt": _tilt_errors(self.run, tilts)}


@dataclass(frozen=True)
class Tilt(Study):
    """Detect the tilt of a simulated run, level its discs, and compare both with the truth."""

    run: Positional[Path] = Path("images/e")  # Run made by `python -m tools.simulator`.
    tilt_prior_deg: float = LINE_PRESETS["default"].tilt_prior_deg
    """Prior standard deviation of the tilt about level, degrees."""

    def measured(self) -> Figures:
        with tempfile.TemporaryDirectory() as folder:
            lines = replace(LINE_PRESETS["default"], tilt_prior_deg=self.tilt_prior_deg)
            tilts = _detect_lines(self.run, lines, Path(folder) / "detected.lines")
            errors = _tilt_errors(self.run, tilts)
            settings = CircleSettings(polarity="light", far_limit=0.5)
            medians = dict.fromkeys(("median m", "3-3.5 m", "3.5-4 m"), ".4f")
            table = Table({"tilt": "<7", **medians, "normalised": ".2f"})
            for label, known in (("without", Priors()), ("with", Priors(tilts=tilts))):
                discs = Path(folder) / f"{label}.circles"
                _detect(self.run, {"circles": discs}, known, circles=settings)
                result = compared(self.run, discs, "--gate-m", 0.3)
                far = {b["from_m"]: b["error_median_m"] for b in result["bins"]}
                known_m = result["error_median_m"], far.get(3.0), far.get(3.5)
                table.row(label, *known_m, result["normalised_error"]["per_dof"])
        return {"tilt": errors, **table.figures}


def _tilt_errors(run: Path, tilts: dict[str, FrameTilt]) -> Figures:
    """Tilts against the truth of a rendered or simulated run, on frames with five lines."""
    truth = json.loads((run / "truth.json").read_text())
    errors, normalised = [], []
    for frame in truth["frames"]:
        tilt = tilts.get(frame["prefix"])
        if tilt is not None and tilt.lines >= 5:
            error = np.array([tilt.pitch, tilt.roll]) - frame["tilt"]
            covariance = [[tilt.cpp, tilt.cpr], [tilt.cpr, tilt.crr]]
            errors.append(np.degrees(error))
            normalised.append(squared_mahalanobis(error, covariance) / 2.0)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    figures = {"frames": len(errors), "pitch rms deg": rms[0], "roll rms deg": rms[1],
               "normalised": np.mean(normalised)}  # fmt: skip
    print_figures(figures)
    return figures
