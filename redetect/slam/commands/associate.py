"""``slam associate``: identifiers for a run's rows, and their scores against the file's own."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from redetect import __version__
from redetect.array_types import IntArray
from redetect.landmarks import CircleLandmark, LineLandmark, Row, read_rows, write_rows
from redetect.messages import is_quiet
from redetect.slam.association.loop_closing import unrecognised_return
from redetect.slam.association.run import associate_run
from redetect.slam.association.scoring import Scores, score_run
from redetect.slam.commands import files
from redetect.slam.errors import SlamError, UnregisteredError
from redetect.slam.noise import with_relative_noise
from redetect.slam.options import Associate
from redetect.slam.recording import (
    UNKNOWN_ID,
    Recording,
    camera_xy_of,
    first_poses,
    joined,
    landmark_files,
)
from redetect.storage import demand_distinct, demand_free

#: Share of steps with slips beyond which odometry is doubted; of run e less than one in a hundred.
_MANY_SLIPS = 0.1
#: Labels (n,) of a file's rows, by the kind of the rows.
Labels = dict[type[CircleLandmark] | type[LineLandmark], IntArray]


def perform(options: Associate) -> int:
    """Execute the command; returns the exit code."""
    settings = options.settings
    files_of_runs = [landmark_files(run, **options.rows) for run in options.runs]
    sources = [(k, file) for k, own in enumerate(files_of_runs) for file in own]
    targets = [_target(options, k, source, len(sources) > 1) for k, source in sources]
    if len(set(targets)) < len(targets):
        raise SlamError(f"{targets[0]} for several runs: expected each in its folder, or -o")
    report = (options.output or targets[0]).with_suffix(".json")
    demand_distinct([*targets, report])
    demand_free([*targets, report], overwrite=options.force)
    runs = files.recordings_of(options)
    recording = joined(runs)
    camera_xy = camera_xy_of(recording, options.run, options.camera)

    tries: list[dict[str, Any]] = []
    for factor in (0.0, *options.noise):
        noisy = with_relative_noise(recording, factor, options.seed) if factor else recording
        # The rows' own gate grows with their covariances.
        began = time.perf_counter()
        try:
            found = associate_run(noisy, settings, camera_xy=camera_xy, progress=_progress)
        except UnregisteredError as error:
            k = int(np.searchsorted(first_poses(runs), error.frame + 1, side="right")) - 1
            raise SlamError(f"{options.runs[k]}: {error}") from None
        finally:
            _progress("")
        seconds = time.perf_counter() - began
        scores = score_run(recording, found)
        figures = {"seconds": round(seconds, 2), "loop_matches": len(found.matches)}
        tries.append({"noise": factor, **figures, "scores": scores})
        print("\n".join(score_lines(factor, seconds, scores)))
        if factor == 0.0:
            result = found

    of_discs = np.split(result.circle_labels, np.cumsum([len(run.circles) for run in runs]))
    of_lines = np.split(result.line_labels, np.cumsum([len(run.lines) for run in runs]))
    for (k, source), target in zip(sources, targets):
        rows = list(read_rows(source))
        labels: Labels = {CircleLandmark: of_discs[k], LineLandmark: of_lines[k]}
        write_rows(target, identified_rows(rows, labels, source), overwrite=options.force)
        print(f"{target}: {_counted(rows, labels)}")
    of_steps = np.split(result.slips > 1.0, np.cumsum([len(run) for run in runs]))
    for run, own, slipped in zip(runs, of_discs, of_steps):
        if 2 * np.count_nonzero(own < 0) > len(own):
            print(_doubt(run, "most rows match no disc that is seen again"), file=sys.stderr)
        elif np.mean(slipped) > _MANY_SLIPS:
            lost = f"{np.count_nonzero(slipped)} of {len(run)} steps lose the discs in view"
            print(_doubt(run, lost), file=sys.stderr)
    if result.path is not None and len(recording.circles) and not result.matches:
        back = unrecognised_return(recording, result.circle_labels, result.path)
        if back is not None:
            print(_not_closed(recording, *back), file=sys.stderr)
    content = {
        "version": __version__,
        "run": str(options.run),
        "more": [str(run) for run in options.more],
        "settings": settings,
        "seed": options.seed,
        "runs": tries,
    }
    files.write_json(report, content, overwrite=options.force)
    return 0


def score_lines(noise: float, seconds: float, scores: Scores) -> list[str]:
    """The scores as lines of a table for the terminal."""
    lines = [f"noise {noise:g}: {seconds:.1f} s" + ("" if scores else ", no IDs to score against")]
    for kind, stages in scores.items():
        for stage, s in stages.items():
            lines.append(
                f"  {kind:7} {stage:5}  pairs: precision {s.pair_precision:.4f} recall "
                f"{s.pair_recall:.4f}  rows right {s.right_rows:.4f}  landmarks "
                f"{s.found_landmarks} of {s.true_landmarks}  wrong merges {s.wrong_merges}  "
                f"splits {s.splits}  without label {s.unlabelled_rows}"
            )
    return lines


def identified_rows(rows: Sequence[Row], labels: Labels, source: Path) -> Iterator[Row]:
    """Rows of a file with the IDs found, from 1, or -1; everything else unchanged."""
    numbers: dict[type, Iterator[int]] = {}
    for kind, own in labels.items():
        count = sum(isinstance(row.record, kind) for row in rows)
        if count not in (0, len(own)):
            raise SlamError(f"{source}: {count} rows of a kind: expected the {len(own)} associated")
        numbers[kind] = iter(np.where(own >= 0, own + 1, UNKNOWN_ID).tolist())
    for row in rows:
        if isinstance(row.record, CircleLandmark | LineLandmark):
            yield row.with_record(replace(row.record, ids=(next(numbers[type(row.record)]),)))
        else:
            yield row


def _counted(rows: Sequence[Row], labels: Labels) -> str:
    """The numbers of landmarks of each kind found in a file, in words."""
    parts = []
    for (kind, own), name in zip(labels.items(), ("discs", "lines")):
        if any(isinstance(row.record, kind) for row in rows):
            parts.append(f"{len(np.unique(own[own >= 0]))} {name}")
            if np.any(own < 0):
                parts[-1] += f" and {np.count_nonzero(own < 0)} rows that match none of them"
    return ", ".join(parts) or "no landmarks"


def _doubt(run: Recording, sign: str) -> str:
    """What may be wrong with a run, and a sign of it."""
    length, reach = files.lengths_of(run)
    return (
        f"{sign}: do rows and odometry fit each other? Steps are {length:.2g} m long (median), "
        f"rows {np.median(reach):.2g} m away; expected metres, radians, and the axes of the robot, "
        "X left and Y backward"
    )


def _not_closed(recording: Recording, earlier: int, later: int) -> str:
    """That no loop is closed, and where odometry leads back to a place."""
    return (
        f"no loop is closed, although by odometry {recording.prefixes[later]} is at the place of "
        f"{recording.prefixes[earlier]}: its discs are too few, too regular or among too much "
        "clutter to be recognised"
    )


def _target(options: Associate, run: int, source: Path, several: bool) -> Path:
    """The output file for one of a run's files."""
    output = options.output
    if output is None:
        return source.with_name(f"associated{source.suffix}")
    if options.more:
        output = output.with_stem(f"{output.stem}_{run + 1}")
    return output.with_suffix(source.suffix) if several else output


def _progress(text: str) -> None:
    if sys.stderr.isatty() and not is_quiet():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
