"""The command ``detect tune``: parameters over a grid, compared with reference rows."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import asdict, replace
from typing import Any

from detect import __version__
from detect.comparison.result import CompareOptions
from detect.drawing.inputs import select_frames
from detect.errors import EXIT_FRAMES_FAILED, DetectError
from detect.line_settings import PRESETS
from detect.runs.known import FramesByImage
from detect.runs.progress import print_failures, progress_bar
from detect.runs.workers import default_jobs, local_workers
from detect.settings import PUBLISHED, CircleSettings
from detect.sources.opening import demand_recording, open_calibrated
from detect.tune.grid import combinations
from detect.tune.run import Settings, tune_run
from detect.tune.table import curve_picture, trial_records
from detect.viewing_options import Tune
from redetect.landmarks import LandmarkFileError, read_tilts
from redetect.storage import OutputExistsError, write_whole


def perform(options: Tune) -> int:
    """Carry the command out; returns the exit code."""
    base: Settings = PUBLISHED if options.preset == "published" else CircleSettings()
    if options.verticals:
        base = PRESETS[options.preset]
    varied = {name: text for name, text in vars(options.grid).items() if text is not None}
    grid = combinations(type(base), varied, options.most)
    settings = [replace(base, **combination) for combination in grid]
    if options.verticals and options.tilt is not None:
        raise DetectError("--tilt and --verticals: verticals show the tilt themselves")

    demand_recording(options.run)
    run = open_calibrated(options.run, options.camera, options.source)
    output = run.output("tune") if options.output is None else options.output
    outputs = {name: output / name for name in ("table.csv", "table.json", "curve.png")}
    for path in outputs.values():
        if path.exists() and not options.force:
            raise OutputExistsError(path)
    path = options.reference or run.folder / ("map.lines" if options.verticals else "map.circles")
    if not path.is_file():
        raise LandmarkFileError(path, None, "no such reference rows: give some with --reference")
    reference = FramesByImage(path)
    _, selection = select_frames(run.frames, options.frames, options.every)
    chosen = [
        frame for _, frame in selection if frame.image is not None or frame.content is not None
    ]
    wanted = [(frame, reference.get(frame.step.prefix)) for frame in chosen]
    frames = [(frame, rows) for frame, rows in wanted if rows is not None]
    if not frames:
        raise DetectError(f"{path}: none of the {len(chosen)} chosen frames: expected some of them")

    gates = CompareOptions(**vars(options.gates), only_identified=options.only_identified)
    count = len(grid) * len(frames)
    workers = local_workers(default_jobs(count) if options.jobs is None else options.jobs)
    tilts = None if options.tilt is None else read_tilts(options.tilt)
    with progress_bar("trials", count) as advance:
        trials = list(
            tune_run(run, frames, settings, gates, workers, tilts=tilts, on_progress=advance)
        )
    records = trial_records(grid, trials, "deg" if options.verticals else "m")
    head = {
        "version": __version__,
        "run": run.name,
        "reference": path.name,
        "frames": [frame.step.prefix for frame, _ in frames],
        "gate": asdict(gates),
        "camera": run.camera.content_hash,
        "settings": {name: _plain(value) for name, value in asdict(base).items()},
        "varied": varied,
    }
    table = io.StringIO()
    writer = csv.DictWriter(table, list(records[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({**r, "front": int(r["front"]), "knee": int(r["knee"])} for r in records)
    document = json.dumps({**head, "trials": records}, indent=1, allow_nan=False)
    title = f"{len(grid)} settings on {len(frames)} frames of {run.name}"
    contents = {
        "table.csv": table.getvalue().encode(),
        "table.json": f"{document}\n".encode(),
        "curve.png": curve_picture(grid, trials, title),
    }
    output.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        with write_whole(outputs[name], overwrite=options.force) as stream:
            stream.write(content)
    print(f"{output}: {title}: {', '.join(contents)}")
    for record in records:
        if record["knee"]:
            values = " ".join(f"--{name.replace('_', '-')} {record[name]}" for name in varied)
            print(
                f"knee: {values}: recall {record['recall']:.3f}, "
                f"precision {record['precision']:.3f}"
            )
    failures = sorted({failure for trial in trials for failure in trial.failures})
    print_failures(len(failures), failures)
    return EXIT_FRAMES_FAILED if failures else 0


def _plain(value: Any) -> Any:
    """A setting for JSON: what it does not have (infinity, tuples) as words."""
    plain = isinstance(value, bool | int | str) or (
        isinstance(value, float) and math.isfinite(value)
    )
    return value if plain else str(value)
