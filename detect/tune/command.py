"""The command ``detect tune``: parameters over a grid, compared with reference rows."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from detect import __version__
from detect.comparison.result import LineCompareOptions
from detect.drawing.inputs import select_frames
from detect.errors import EXIT_FRAMES_FAILED, DetectError
from detect.line_settings import PRESETS, LineSettings
from detect.runs.known import FramesByImage
from detect.runs.progress import print_failures, progress_bar
from detect.runs.workers import default_jobs, local_workers
from detect.settings import PUBLISHED, CircleSettings
from detect.sources.opening import demand_recording, open_calibrated
from detect.tune.grid import combinations, settings_with
from detect.tune.run import Settings, tune_run
from detect.tune.table import curve_picture, records_csv, records_json, trial_records
from detect.viewing_options import Tune
from landmarks import LandmarkFileError, read_tilts
from storage import OutputExistsError, write_whole


def perform(options: Tune) -> int:
    """Carry the command out; returns the exit code."""
    base: Settings
    if options.verticals:
        base = PRESETS[options.preset]
    else:
        base = PUBLISHED if options.preset == "published" else CircleSettings()
    kind = type(base)
    varied = {name: text for name, text in vars(options.grid).items() if text is not None}
    grid = combinations(kind, varied, options.most)
    settings = [settings_with(base, combination) for combination in grid]
    if options.verticals and options.tilt is not None:
        raise DetectError("--tilt and --verticals: verticals show the tilt themselves")

    demand_recording(options.run)
    run = open_calibrated(options.run, options.camera, options.source)
    output = run.output("tune") if options.output is None else options.output
    outputs = {name: output / name for name in ("table.csv", "table.json", "curve.png")}
    for path in outputs.values():
        if path.exists() and not options.force:
            raise OutputExistsError(path)
    usual = "map.lines" if options.verticals else "map.circles"
    path = run.folder / usual if options.reference is None else options.reference
    reference = _reference(path)
    selection = select_frames(run.frames, options.frames, options.every)
    chosen = [
        frame
        for _, frame in selection.of(run.frames)
        if frame.image is not None or frame.content is not None
    ]
    wanted = [(frame, reference.get(frame.step.prefix)) for frame in chosen]
    known = [(frame, rows) for frame, rows in wanted if rows is not None]
    if not known:
        raise DetectError(f"{path}: none of the {len(chosen)} chosen frames: expected some of them")

    gates = options.gates
    gate: Any
    if options.verticals:
        gate = LineCompareOptions(
            gates.tolerance_deg, gates.sigmas, only_identified=options.only_identified
        )
    else:
        gate = dataclasses.replace(gates.discs, only_identified=options.only_identified)
    count = len(grid) * len(known)
    jobs = default_jobs(count) if options.jobs is None else options.jobs
    with progress_bar("trials", count) as advance:
        trials = list(
            tune_run(
                run,
                [frame for frame, _ in known],
                [rows for _, rows in known],
                settings,
                gate,
                local_workers(jobs),
                tilts=None if options.tilt is None else read_tilts(options.tilt),
                on_progress=advance,
            )
        )
    records = trial_records(grid, trials, "deg" if options.verticals else "m")
    head = {
        "version": __version__,
        "run": run.name,
        "reference": path.name,
        "frames": [frame.step.prefix for frame, _ in known],
        "gate": dataclasses.asdict(gate),
        "camera": run.camera.content_hash,
        "settings": _jsonable(base),
        "varied": varied,
    }
    title = f"{len(grid)} settings on {len(known)} frames of {run.name}"
    contents = {
        "table.csv": records_csv(records),
        "table.json": records_json(head, records),
        "curve.png": curve_picture(grid, trials, title),
    }
    output.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        with write_whole(outputs[name], overwrite=options.force) as stream:
            stream.write(content)
    print(f"{output}: {title}: table.csv, table.json, curve.png")
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


def _reference(path: Path) -> FramesByImage:
    if not path.is_file():
        raise LandmarkFileError(path, None, "no such reference rows: give some with --reference")
    return FramesByImage(path)


def _jsonable(settings: CircleSettings | LineSettings) -> dict[str, Any]:
    """Settings by name; numbers that JSON does not have (infinity) as words."""
    return {
        name: value if isinstance(value, bool | int | str) else _finite_or_word(value)
        for name, value in dataclasses.asdict(settings).items()
    }


def _finite_or_word(value: Any) -> Any:
    if isinstance(value, float) and abs(value) != float("inf"):
        return value
    return str(value)
