"""The detectors on images whose truth is known, scored by the scripts beside the data."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tyro.conf import Positional

from detect.comparison.compare import compare_with_file
from detect.comparison.result import DiscComparison
from detect.line_settings import PRESETS as LINE_PRESETS
from detect.line_settings import LineSettings
from detect.runs.plan import FramePlan, Job, Known
from detect.runs.stream import detect_run
from detect.settings import CircleSettings, Polarity
from detect.sources.opening import open_run
from detect.viewing_options import CompareOptions
from redetect.landmarks import FrameTilt, read_frames, read_tilts, squared_mahalanobis
from tools.evaluation.tables import Table

Preset = Literal["default", "published", "report"]


def _detect(
    run: Path, places: dict[str, Path], known: Known | None = None, **settings: Any
) -> None:
    """Detect a run's `circles` or `lines` with settings of theirs; failures go to stderr."""
    opened = open_run(run)
    job = Job(opened, FramePlan(opened.camera, **settings), places, known or Known())
    for failure in detect_run(job).failures:
        print(failure, file=sys.stderr)


def _detect_lines(run: Path, settings: LineSettings, output: Path) -> dict[str, FrameTilt]:
    """Write a run's verticals; returns their tilts."""
    tilts = output.with_suffix(".tilt")
    _detect(run, {"lines": output, "tilt": tilts}, lines=settings)
    return read_tilts(tilts)


def _score(script: Path, *arguments: object, folder: str | None = None) -> int:
    # A scorer may bring a module named camera: in a folder of its own it does not find ours.
    words = [sys.executable, str(script.resolve()), *map(str, arguments)]
    return subprocess.run(words, check=False, cwd=folder).returncode


def _score_photographs(data: Path, kind: str, settings: Any) -> int:
    """Detect one kind of landmarks in every folder below `data`/dev, and score the files."""
    with tempfile.TemporaryDirectory() as folder:
        files = []
        for run in sorted(path.parent for path in data.glob("dev/*/truth.json")):
            files.append(Path(folder) / f"{run.name}.{kind}")
            _detect(run, {kind: files[-1]}, **{kind: settings})
        return _score(data / "evaluate.py", f"--{kind}", *files)


@dataclass(frozen=True)
class Photographs:
    """Detect the discs of every folder below DATA/dev and score them with DATA/evaluate.py."""

    data: Positional[Path] = Path("../shared/data/discs")  # Folder with `evaluate.py` and `dev`.

    def __call__(self) -> int:
        return _score_photographs(self.data, "circles", CircleSettings())


@dataclass(frozen=True)
class Buildings:
    """Detect the verticals of every folder below DATA/dev and score them with DATA/evaluate.py."""

    data: Positional[Path] = Path("../shared/data/york")  # Folder with `evaluate.py` and `dev`.
    preset: Preset = "default"  # Of the line detector.

    def __call__(self) -> int:
        return _score_photographs(self.data, "lines", LINE_PRESETS[self.preset])


@dataclass(frozen=True)
class Rendered:
    """Detect a rendered run's light discs, its verticals and the tilt, and level the discs.

    Scored by its evaluate.py: the discs, the verticals, and the discs levelled.
    """

    run: Positional[Path] = Path("../shared/data/rendered/r1")  # `evaluate.py` lies beside it.
    preset: Preset = "default"  # Of the line detector.
    polarity: Polarity = "light"  # Stated to the detector of discs.

    def __call__(self) -> int:
        code = 0
        with tempfile.TemporaryDirectory() as folder:
            discs, lines, levelled = (
                Path(folder) / name
                for name in ("detected.circles", "detected.lines", "levelled.circles")
            )
            settings = CircleSettings(polarity=self.polarity)
            _detect(self.run, {"circles": discs}, circles=settings)
            tilts = _detect_lines(self.run, LINE_PRESETS[self.preset], lines)
            _detect(self.run, {"circles": levelled}, Known(tilts=tilts), circles=settings)
            for path in (discs, lines, levelled):
                print(path.name, flush=True)
                code |= _score(self.run.parent / "evaluate.py", self.run.name, path, folder=folder)
        _print_tilt_errors(self.run, tilts)
        return code


@dataclass(frozen=True)
class Tilt:
    """Detect the tilt of a simulated run, level its discs, and compare both with the truth."""

    run: Positional[Path] = Path("images/e")  # Run made by `python -m tools.simulator`.
    tilt_prior_deg: float = LINE_PRESETS["default"].tilt_prior_deg
    """What is known of the tilt beforehand: its standard deviation about level, degrees."""

    def __call__(self) -> int:
        with tempfile.TemporaryDirectory() as folder:
            lines = replace(LINE_PRESETS["default"], tilt_prior_deg=self.tilt_prior_deg)
            tilts = _detect_lines(self.run, lines, Path(folder) / "detected.lines")
            _print_tilt_errors(self.run, tilts)
            settings = CircleSettings(polarity="light", far_limit=0.5)
            table = Table(
                {"discs": "<17", "median error / m": ".4f", "from 3 m on, by bin / m": "<",
                 "normalised error^2 / dof": ".2f"}
            )  # fmt: skip
            for label, known in (("without", Known()), ("with", Known(tilts=tilts))):
                discs = Path(folder) / f"{label}.circles"
                _detect(self.run, {"circles": discs}, known, circles=settings)
                result = compare_with_file(
                    "circles",
                    Path(self.run) / "map.circles",
                    read_frames(discs),
                    CompareOptions(gate_m=0.3),
                )
                assert isinstance(result, DiscComparison)
                if result.error_median_m is None:
                    print(f"discs {label} the tilt: none is near one of {result.reference_name}")
                    continue
                far = [b for b in result.bins if b.from_m is not None and b.from_m >= 3.0]
                errors = [b.error_median_m for b in far if b.error_median_m is not None]
                table.row(
                    f"{label} the tilt", result.error_median_m,
                    " ".join(f"{error:.4f}" for error in errors),
                    result.normalised_error.per_dof,
                )  # fmt: skip
        return 0


def _print_tilt_errors(run: Path, tilts: dict[str, FrameTilt]) -> None:
    """Compare tilts with the truth of a rendered or simulated run."""
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
    print(
        f"tilt: {len(errors)} frames with 5 lines, rms error pitch {rms[0]:.3f} deg "
        f"roll {rms[1]:.3f} deg, normalised error^2 / dof {np.mean(normalised):.2f}"
    )
