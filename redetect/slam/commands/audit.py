"""``slam audit``: rows whose identifier contradicts the rest, and the run without them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from camera import Camera
from redetect import __version__
from redetect.landmarks import CircleLandmark, Row, read_frames, read_rows, write_rows
from redetect.landmarks.map_file import write_table
from redetect.slam.commands.files import recording_of
from redetect.slam.mapping.audit import Audit, audit_run, audited_rows
from redetect.slam.options import Audit as Options
from redetect.slam.pictures import Crop, draw_crops, picture_of_frame
from redetect.slam.recording import Recording, camera_of_run, landmark_files
from redetect.storage import demand_distinct, demand_free, write_bytes

_COLUMNS = (
    *("frame", "prefix", "line", "id", "kind", "new_id", "x_m", "y_m"),
    *("from_own_m", "row_chi_squared", "chi_squared", "mended_chi_squared"),
)


def perform(options: Options) -> int:
    """Execute the command; returns the exit code."""
    (source,) = landmark_files(options.run, stem=options.stem)
    target = options.output or source.with_name("audited.circles")
    listed = target.with_suffix(".csv")
    demand_distinct((target, listed))
    demand_free((target, listed), overwrite=options.force)
    recording = recording_of(options)
    camera = None
    if options.calibrate or options.pictures:
        camera = camera_of_run(options.run, options.camera)
    audit = audit_run(
        recording,
        camera if options.calibrate else None,
        calibrate=options.calibrate,
        gate=options.gate,
        name=str(options.run),
    )
    rows = list(read_rows(source))
    write_rows(target, audited_rows(rows, audit, options.apply), overwrite=options.force)
    table, head = _table(recording, audit, rows), f"slam audit {__version__}: {source.name}"
    write_table(listed, _COLUMNS, table, [head], overwrite=options.force)
    for line in _report(recording, audit):
        print(line)
    print(f"{target}, {listed.name}")
    if options.pictures is not None and camera is not None:
        _draw(options, camera, audit, source)
    return 0


def _table(recording: Recording, audit: Audit, rows: Iterable[Row]) -> list[list[object]]:
    """The contradicting rows, with columns as in `_COLUMNS`."""
    line = [row.line for row in rows if isinstance(row.record, CircleLandmark)]
    table: list[list[object]] = []
    for group in audit.groups:
        for k, (x, y), own in zip(group.rows, group.xy, group.row_chi_squared):
            frame = int(recording.circles.frame[k])
            numbers = (group.own_m, own, group.chi_squared, group.mended_chi_squared)
            table.append(
                [frame, recording.prefixes[frame], line[k], group.id, group.kind, group.new_id]
                + [f"{value:.3f}" for value in (x, y)]
                + ["" if np.isnan(value) else f"{value:.2f}" for value in numbers]
            )
    return table


def _report(recording: Recording, audit: Audit) -> list[str]:
    head = f"{'frames':<12}{'rows':>5}{'ID':>7}  {'at (m)':<18}{'off by':>8}{'chi-squared':>13}"
    lines = [f"{head}  shows"]
    for group in audit.groups:
        shows = {
            "exchange": f"{group.new_id}: chi-squared {group.mended_chi_squared:.1f}",
            "split": f"one of its own, {group.new_id}: chi-squared {group.mended_chi_squared:.1f}",
            "drop": "no landmark",
        }[group.kind]
        x, y = np.median(group.xy, axis=0)
        first, last = recording.circles.frame[group.rows[[0, -1]]]
        frames = f"{first}" if first == last else f"{first}-{last}"
        lines.append(
            f"{frames:<12}{len(group.rows):>5}{group.id:>7}  "
            f"{f'{x:.2f}, {y:.2f}':<18}{group.own_m:>6.2f} m{group.chi_squared:>13,.1f}  {shows}"
        )
    lines.append(f"{'':<12}{'rows':>8}{'discs':>8}{'chi-squared':>14}{'expected':>10}{'factor':>8}")
    tables = {"as written": audit.before, "dropped": audit.dropped, "mended": audit.mended}
    for name, table in tables.items():
        lines.append(
            f"{name:<12}{table.measurements:>8,}{table.landmarks:>8,}{table.chi_squared:>14,.2f}"
            f"{table.expected:>10,}{f'{table.factor:.2f}' if table.expected > 0 else '-':>8}"
        )
    return lines


def _draw(options: Options, camera: Camera, audit: Audit, source: Path) -> None:
    """Crops of the images at the rows of each group."""
    assert options.pictures is not None
    images, frames = options.images or source.parent, list(read_frames(source))
    seen = [(k, disc) for k, frame in enumerate(frames) for disc in frame.circles]
    drawn = 0
    for group in audit.groups:
        crops = []
        for row in group.rows:
            k, disc = seen[row]
            file = picture_of_frame(images, frames[k].step.prefix)
            # Levelled positions are mapped back to where the camera saw them.
            turn = Rotation.from_rotvec([*(frames[k].levelled_by or (0.0, 0.0)), 0.0]).as_matrix()
            u, v = camera.project_robot(np.array([disc.px, disc.py, 0.0]) @ turn)
            if file is not None and np.isfinite(u):
                crops.append(Crop(file, (float(u), float(v)), f"{k}"))
        if crops:
            options.pictures.mkdir(parents=True, exist_ok=True)
            name = f"frame-{seen[group.rows[0]][0]:04d}-id-{group.id}.png"
            picture = draw_crops(crops, f"ID {group.id}: {group.kind}")
            write_bytes(options.pictures / name, picture, overwrite=options.force)
            drawn += 1
    print(f"{options.pictures}: pictures of {drawn} of {len(audit.groups)} groups")
