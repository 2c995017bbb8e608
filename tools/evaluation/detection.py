"""The detectors on images whose truth is known, scored by the scripts beside the data."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree
from tyro.conf import Positional

from detect.line_settings import DEFAULT
from detect.settings import Polarity
from redetect.landmarks import read_frames, read_tilts, squared_mahalanobis
from redetect.landmarks.arrays import circle_arrays
from tools.evaluation.figures import (
    Figures,
    Study,
    StudyError,
    compared,
    demand_some,
    print_figures,
    run_program,
)
from tools.evaluation.tables import Table

Preset = Literal["default", "published", "report"]
#: Rows at most this far from a disc of a photograph have found it, as in the scorer.
_MATCH_M = 0.05
#: A line of the scorer's output, and the names of its numbers.
_LINE = re.compile(
    r"(\S+) +images +(\d+) discs +(\d+) recall +([\d.]+) +FP/img +([\d.]+) +err mm med +([\d.]+)"
)
_NAMES = ("images", "discs", "recall", "false", "median_mm")


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

    def measure(self) -> Figures:
        normalised: list[float] = []
        with tempfile.TemporaryDirectory() as folder:
            files = []
            for truth in sorted(self.data.glob("dev/*/truth.json")):
                files.append(Path(folder) / f"{truth.parent.name}.circles")
                run_program("detect", "circles", truth.parent, "--output", files[-1])
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

    def measure(self) -> Figures:
        with tempfile.TemporaryDirectory() as folder:
            files = []
            for run in sorted(path.parent for path in self.data.glob("dev/*/truth.json")):
                files.append(Path(folder) / f"{run.name}.lines")
                run_program("detect", "lines", run, "--preset", self.preset, "--output", files[-1])
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

    def measure(self) -> Figures:
        figures: dict[str, Any] = {}
        with tempfile.TemporaryDirectory() as folder:
            discs, lines, tilts, levelled = (
                Path(folder) / name
                for name in ("discs.circles", "lines.lines", "lines.tilt", "levelled.circles")
            )
            circles = "detect", "circles", self.run, "--polarity", self.polarity, "--output"
            run_program(*circles, discs)
            run_program("detect", "lines", self.run, "--preset", self.preset, "--output", lines)
            run_program(*circles, levelled, "--tilt", tilts)
            script = self.run.parent / "evaluate.py"
            for path in (discs, lines, levelled):
                print(path.name, flush=True)
                text = _scored(script, self.run.name, path, folder=folder)
                figures[path.stem] = json.loads(text)
            tilt = _tilt_errors(self.run, tilts)
        return {**figures, "tilt": tilt}


@dataclass(frozen=True)
class Tilt(Study):
    """Detect the tilt of a simulated run, level its discs, and compare both with the truth."""

    run: Positional[Path] = Path("images/e")  # Run made by `python -m tools.simulator`.
    tilt_prior_deg: float = DEFAULT.tilt_prior_deg
    """Prior standard deviation of the tilt about level, degrees."""

    def measure(self) -> Figures:
        with tempfile.TemporaryDirectory() as folder:
            lines, tilts = (Path(folder) / f"detected.{kind}" for kind in ("lines", "tilt"))
            prior = "--tilt-prior-deg", self.tilt_prior_deg
            run_program("detect", "lines", self.run, *prior, "--output", lines)
            errors = _tilt_errors(self.run, tilts)
            medians = dict.fromkeys(("median m", "3-3.5 m", "3.5-4 m"), ".4f")
            table = Table({"tilt": "<7", **medians, "normalised": ".2f"})
            settings = "--polarity", "light", "--far-limit", 0.5
            for label, flags in (("without", ()), ("with", ("--tilt", tilts))):
                discs = Path(folder) / f"{label}.circles"
                run_program("detect", "circles", self.run, *settings, *flags, "--output", discs)
                result = compared(self.run, discs, "--gate-m", 0.3)
                far = {b["from_m"]: b["error_median_m"] for b in result["bins"]}
                known_m = result["error_median_m"], far.get(3.0), far.get(3.5)
                table.row(label, *known_m, result["normalised_error"]["per_dof"])
        return {"tilt": errors, **table.figures}


def _tilt_errors(run: Path, path: Path) -> Figures:
    """Tilts against the truth of a rendered or simulated run, on frames with five lines."""
    truth, tilts = json.loads((run / "truth.json").read_text()), read_tilts(path)
    errors, normalised = [], []
    for frame in truth["frames"]:
        tilt = tilts.get(frame["prefix"])
        if tilt is not None and tilt.lines >= 5:
            error = np.array([tilt.pitch, tilt.roll]) - frame["tilt"]
            covariance = [[tilt.cpp, tilt.cpr], [tilt.cpr, tilt.crr]]
            errors.append(np.degrees(error))
            normalised.append(squared_mahalanobis(error, covariance) / 2.0)
    demand_some(errors, f"{run}: tilts of frames with five lines")
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    figures = {"frames": len(errors), "pitch rms deg": rms[0], "roll rms deg": rms[1],
               "normalised": np.mean(normalised)}  # fmt: skip
    print_figures(figures)
    return figures
