"""The report as one HTML page: no scripts, nothing loaded, all content of files escaped."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from redetect.groundtruth.files import is_number
from redetect.groundtruth.report.inputs import STREAMS, Inputs, in_visits
from redetect.groundtruth.report.pictures import (
    Series,
    Track,
    clock_figure,
    ellipse_figure,
    map_figure,
    series_figure,
    stages_figure,
)
from redetect.groundtruth.trajectories.streams import PlanarPoses, matched_streams
from redetect.groundtruth.validation import scoring
from redetect.groundtruth.validation.reference_poses import Dimension, SurveyedFiducials
from redetect.plane import apply, fitted, pose_differences
from redetect.reporting.page import Part, Section, image_part, page_of

# Colours and dashes, which distinguish streams without colour, too.
_LOOKS: dict[str, tuple[str, tuple[float, ...]]] = {
    "laser": ("#1f5f99", ()),
    "camera": ("#b8560f", (6, 3)),
    "filtered": ("#b03a48", (4, 2)),
    "fused": ("#2b7a3a", (10, 3, 2, 3)),
    "odometry": ("#7a4fa0", (2, 3)),
    "truth": ("#222222", (1, 3)),
}
_MOST_ROWS = 40
_NEES_COLUMN = 9
_ELLIPSES = 60
# Width and height of the validation's plots on the page.
_VALIDATION_PX = (864, 410)
_SCANS_PX, _ALIGNMENT_PX = (864, 237), (864, 274)


def report_page(inputs: Inputs, version: str) -> bytes:
    """The whole page, UTF-8; the same inputs and `version` of the program give the same bytes."""
    sections = [
        Section("state", "Contents of the session", _state(inputs)),
        Section("building", "Drawing and fiducials", _building(inputs)),
        Section("scanners", "Fixed scanners", _scanners(inputs)),
        Section("map", "Map and path", _maps(inputs)),
        Section("stages", "A visit, stage by stage", _stages(inputs)),
        Section("errors", "Errors against the truth", _errors(inputs)),
        Section("validation", "Validation at reference poses", _validation(inputs)),
        Section("clock", "Clocks", _clock(inputs)),
        Section("rejected", "Rejected and lost", _rejected(inputs)),
        Section("settings", "Settings and versions", _settings(inputs, version)),
    ]
    return page_of(f"Ground truth: {inputs.name}", sections)


def table(
    caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], text: Sequence[int] = ()
) -> Part:
    """A table whose first column names the row; the columns in `text` are words, not numbers."""
    return Part("table", caption, tuple(head), tuple(map(tuple, rows)), left=(0, *text))


def _state(inputs: Inputs) -> list[Part]:
    rows = [(STREAMS[name], *_extent(poses)) for name, poses in inputs.streams.items()]
    if inputs.truth is not None:
        rows.append(("truth", *_extent(inputs.truth)))
    content: list[Part] = []
    if rows:
        head = ("stream", "poses", "from / s", "to / s", "covariances")
        content.append(table("Streams of poses", head, rows, text=(4,)))
    if inputs.visits:
        spans = ", ".join(f"{b - a:.0f} s" for a, b in inputs.visits[:_MOST_ROWS])
        content.append(Part("text", f"{len(inputs.visits)} visits to the covered area: {spans}."))
    content += [Part("problem", f"Cannot be read: {problem}") for problem in inputs.problems]
    if inputs.missing:
        content.append(Part("note", "Missing in the session: " + ", ".join(inputs.missing) + "."))
    return content


def _extent(poses: PlanarPoses) -> tuple[str, str, str, str]:
    with_them = "yes" if poses.covariances is not None else "no"
    first, last = f"{poses.times_s[0]:.3f}", f"{poses.times_s[-1]:.3f}"
    return str(len(poses)), first, last, with_them


def _building(inputs: Inputs) -> list[Part]:
    content = _dimensions(inputs.dimensions) if inputs.dimensions else []
    content += [] if inputs.fiducials is None else _fiducials(inputs.fiducials)
    return content or [Part("note", "No measurements in the building: no dimensions.csv.")]


def _dimensions(dimensions: Sequence[Dimension]) -> list[Part]:
    off = 1e3 * np.array([d.drawn_m - d.measured_m for d in dimensions])
    rows = [
        (d.name, f"{d.drawn_m:.3f}", f"{d.measured_m:.3f}", f"{e:+.1f}")
        for d, e in zip(dimensions[:_MOST_ROWS], off)
    ]
    head = ("dimension", "drawn / m", "measured / m", "drawn minus measured / mm")
    caption = "Dimensions in the drawing and measured in the building"
    sigma, worst = scoring.sigma_of(off), np.abs(off).max()
    words = f"{len(off)} dimensions: mean {off.mean():+.1f} mm, sigma {sigma:.1f} mm, "
    words += f"worst {worst:.1f} mm."
    return [table(caption, head, rows), Part("text", words)]


def _fiducials(found: SurveyedFiducials) -> list[Part]:
    rows = [
        (name, *(f"{v:.4f}" for v in place), *(f"{1e3 * v:.1f}" for v in sigma),
         *(f"{1e3 * v:+.1f}" for v in place - drawn))
        for name, place, sigma, drawn in zip(found.names, found.places, found.sigma_m, found.drawn)
    ]  # fmt: skip
    head = ("fiducial", "x / m", "y / m", "sigma x / mm", "sigma y", "minus drawn x / mm", "y")
    caption = "Fiducials from the distances between them, aligned rigidly with the drawing"
    rms = 1e3 * float(np.sqrt(np.mean(found.residuals_m**2)))
    words = f"{len(found.residuals_m)} distances, rms residual {rms:.1f} mm."
    return [table(caption, head, rows), Part("text", words)]


def _scanners(inputs: Inputs) -> list[Part]:
    document = inputs.documents.get("aligned.json")
    if document is None:
        return [Part("note", "No aligned.json: groundtruth lasers writes it.")]
    content: list[Part] = []
    steps = _entry(document, "steps", dict)
    names = [str(s.get("name")) for s in _entries(document, "scanners")]
    rows = []
    try:
        last = np.array(steps.get("each to the map"), dtype=np.float64).reshape(len(names), 3)
        for step, value in steps.items():
            places = np.array(value, dtype=np.float64).reshape(len(names), 3)[:, :2]
            moved = apply(fitted(places, last[:, :2]), places)
            far = 1e3 * np.hypot(*(moved - last[:, :2]).T)
            rows.append((str(step), *(f"{v:.1f}" for v in far)))
    except (ValueError, TypeError, OverflowError):
        rows = []
    if rows:
        caption = "Distance from the final position after each step, after rigid alignment (mm)"
        content.append(table(caption, ("step", *names), rows))
    words = "Scans of the empty area on the map, and the ICP of each scanner step by step."
    return content + _picture(inputs, "aligned.png", words, _ALIGNMENT_PX)


def _picture(inputs: Inputs, name: str, words: str, size: tuple[int, int]) -> list[Part]:
    """A picture that a command wrote, if it did."""
    picture = inputs.pictures.get(name)
    return [] if picture is None else [image_part(words, picture, "png", *size)]


def _stages(inputs: Inputs) -> list[Part]:
    streams = _all_streams(inputs)
    if len(streams) < 2 or not inputs.visits:
        return [Part("note", "Fewer than two streams of poses: no stages.")]
    number = int(np.argmax([b - a for a, b in inputs.visits]))
    stages = [
        _track(name, in_visits(poses, [inputs.visits[number]]), inputs)
        for name, poses in streams.items()
    ]
    stages = [stage for stage in stages if len(stage.poses)]
    words = f"Visit {number + 1}: " + ", ".join(stage.label for stage in stages)
    words += f"; grey: {stages[-1].label}." if stages else "nothing."
    return [stages_figure(words, stages, inputs.building)] if stages else [Part("note", words)]


def _track(name: str, poses: PlanarPoses, inputs: Inputs) -> Track:
    colour, dashes = _LOOKS[name]
    return Track(STREAMS.get(name, name), colour, dashes, in_visits(poses, inputs.visits))


def _all_streams(inputs: Inputs) -> dict[str, PlanarPoses]:
    """Odometry, if it can be compared, and the others."""
    odometry = {} if inputs.odometry is None else {"odometry": inputs.odometry}
    return {**odometry, **inputs.streams}


def _maps(inputs: Inputs) -> list[Part]:
    tracks = [_track(name, poses, inputs) for name, poses in inputs.streams.items()]
    beside = {"odometry": inputs.odometry, "truth": inputs.truth}
    others = [_track(name, poses, inputs) for name, poses in beside.items() if poses is not None]
    everything = tracks + others
    if not everything and inputs.building is None:
        return [Part("note", "Neither a building nor a stream of poses: nothing to draw.")]
    words = "The building" if inputs.building is not None else "No building map in the session"
    words += f" and the paths during the visits ({', '.join(t.label for t in everything)})."
    if inputs.odometry is not None:
        words += " Odometry is aligned with the truth in each visit."
    content = [map_figure(words, everything, inputs.building)]
    for track in tracks:
        if track.poses.covariances is None or not len(track.poses):
            content.append(Part("note", f"{track.label}: no covariances, no ellipses."))
        else:
            content.append(ellipse_figure(track, inputs.building, _ELLIPSES))
    return content


def _errors(inputs: Inputs) -> list[Part]:
    if inputs.truth is None:
        words = "No truth in the session: give it by --truth to see errors over time."
        return [Part("note", words)]
    rows: list[tuple[str, ...]] = []
    place, turn, faults, outside = [], [], [], []
    compared = [
        (STREAMS.get(name, name), name, in_visits(poses, inputs.visits))
        for name, poses in _all_streams(inputs).items()
    ]
    fused = inputs.streams.get("fused")
    if fused is not None and len(in_visits(fused, inputs.visits)) < len(fused):
        compared.append(("fused, pauses included", "", fused))
    if not compared:
        return [Part("note", "No poses to compare with the truth.")]
    for label, name, poses in compared:
        try:
            mine, theirs, _ = matched_streams(poses, inputs.truth)
        except ValueError as fault:
            rows.append((label, "0", *("-",) * 9))
            faults.append(Part("problem", f"{label}: {fault}"))
            continue
        score = scoring.score_poses(mine, theirs)
        low, high = scoring.normalised_band(max(score.normalised, 1))
        if score.normalised and not low <= score.normalised_error <= high:
            outside.append((len(rows), _NEES_COLUMN))
        rows.append((label, *_score_words(score)))
        if name:
            error = pose_differences(mine.poses, theirs.poses)
            look = (label, *_LOOKS[name], mine.times_s)
            place.append(Series(*look, 1e3 * np.hypot(error[:, 0], error[:, 1])))
            turn.append(Series(*look, np.degrees(np.abs(error[:, 2]))))
    head = (
        "stream", "poses", "mean / mm", "sigma", "rmse", "worst", "mean / deg", "sigma", "worst",
        "NEES / 3", "poses with it",
    )  # fmt: skip
    caption = "Errors during the visits: position (mm) and signed heading (deg)"
    if inputs.odometry is not None:
        caption += "; odometry is aligned with the truth in each visit"
    words = (
        "NEES / 3 is 1 if covariances are right; marked outside of the 95 % interval of "
        "independent errors. Those of neighbouring poses are correlated, so it scatters more."
    )
    return [
        table(caption, head, rows)._replace(marked=tuple(outside)),
        *faults,
        Part("note", words),
        series_figure("Position error over time by visit.", "mm", place, inputs.visits),
        series_figure("Absolute heading error over time by visit.", "deg", turn, inputs.visits),
    ]


def _score_words(score: scoring.PoseScore) -> tuple[str, ...]:
    return (
        str(score.poses),
        *(f"{1e3 * v:.2f}" for v in (score.position_mean_m, score.position_sigma_m,
                                     score.position_rmse_m, score.position_max_m)),
        f"{math.degrees(score.angle_mean_rad):+.3f}",
        f"{math.degrees(score.angle_sigma_rad):.3f}",
        f"{math.degrees(score.angle_max_rad):.3f}",
        f"{score.normalised_error:.3f}" if score.normalised else "-",
        str(score.normalised),
    )  # fmt: skip


def _validation(inputs: Inputs) -> list[Part]:
    document = inputs.documents.get("validation.json")
    if document is None:
        return [Part("note", "No validation in the session: groundtruth validate writes it.")]
    figures = _entry(document, "figures", dict)
    linear = [_number(figures.get(f"position_{k}_m"), 1e3) for k in ("mean", "sigma", "max")]
    angles = [figures.get(f"angle_{k}_rad") for k in ("mean", "sigma", "max")]
    angular = [_number(angle, 180.0 / math.pi, 3) for angle in angles]
    rows = [(str(document.get("poses", "ground truth")), *linear, *angular)]
    for p in scoring.PUBLISHED:
        linear = [f"{1e3 * p.position_mean_m:.0f}", f"{1e3 * p.position_sigma_m:.0f}", "-"]
        angular = [f"{p.angle_mean_deg:+.2f}", f"{p.angle_sigma_deg:.2f}", "-"]
        rows.append((f"{p.name} (published)", *linear, *angular))
    head = ("ground truth", "mean / mm", "sigma", "worst", "mean / deg", "sigma", "worst")
    content = [table("Linear and angular errors at reference poses", head, rows)]
    nees = figures.get("normalised_error")
    words, outside = f"NEES / 3 with both covariances: {_number(nees, 1.0, 3)}", False
    band = [v for v in _entry(figures, "normalised_band", list) if is_number(v)]
    if len(band) == 2 and is_number(nees):
        words += f"; 95 % interval of consistent ones {band[0]:.3f} to {band[1]:.3f}"
        outside = not band[0] <= nees <= band[1]
    count = _number(figures.get("poses"), 1.0, 0)
    content.append(Part("problem" if outside else "text", f"{count} reference poses. {words}."))
    words = "Linear and angular errors at each reference pose."
    content += _picture(inputs, "validation/errors.png", words, _VALIDATION_PX)
    words = "Readings of the scanners on board, for each set of poses."
    content += _picture(inputs, "validation/scans.png", words, _SCANS_PX)
    content += [*_incidence(document), *_mounts(document)]
    refused = [
        (str(r.get("index")), _number(r.get("time_s"), 1.0, 3), str(r.get("status")),
         str(r.get("reason")))
        for r in _entries(document, "refused")[:_MOST_ROWS]
    ]  # fmt: skip
    if refused:
        caption = "Poses not used as reference, or without ground truth"
        content.append(table(caption, ("pose", "t / s", "status", "reason"), refused, text=(2, 3)))
    return content


def _incidence(document: dict[str, Any]) -> list[Part]:
    rows = [
        (f"{_number(r.get('from_deg'), 1.0, 0)} to {_number(r.get('to_deg'), 1.0, 0)}",
         _number(r.get("readings"), 1.0, 0), _number(r.get("mean_m"), 1e3),
         _number(r.get("sigma_m"), 1e3))
        for r in _entries(document, "incidence")[:_MOST_ROWS]
    ]  # fmt: skip
    caption = "Ranges on board minus distances of the walls, by angle of incidence"
    head = ("incidence / deg", "readings", "mean / mm", "sigma")
    return [table(caption, head, rows)] if rows else []


def _mounts(document: dict[str, Any]) -> list[Part]:
    rows = []
    for entry in _entries(document, "mounts")[:_MOST_ROWS]:
        given, refined, sigma = (_entry(entry, key, list) for key in ("given", "refined", "sigma"))
        if len(given) == len(refined) == len(sigma) == 3:
            moved = [_float(b) - _float(a) for a, b in zip(given, refined)]
            scales = ((1e3, 1), (1e3, 1), (180.0 / math.pi, 3))
            words = [
                _number(value, factor, decimals)
                for pose in (given, moved, sigma)
                for value, (factor, decimals) in zip(pose, scales)
            ]
            rows.append((str(entry.get("name")), *words))
    head = ("scanner", "x / mm", "y", "theta / deg", "moved x / mm", "y", "theta / deg",
            "sigma x / mm", "y", "theta / deg")  # fmt: skip
    caption = "Mounts of the scanners on board, as given and refined"
    return [table(caption, head, rows)] if rows else []


def _clock(inputs: Inputs) -> list[Part]:
    if inputs.clock is None:
        return [Part("note", "No clock.json: all times are assumed to be of one clock.")]
    rows = [
        (f"{s.from_s:.2f}", f"{s.to_s:.2f}", f"{1e3 * s.offset_s:+.2f}",
         _number(s.sigma_offset_s, 1e3), f"{1e6 * (s.rate - 1.0):+.1f}",
         _number(s.sigma_rate, 1e6, 1), f"{math.degrees(s.angle_rad):+.3f}",
         f"{math.degrees(s.turned_rad):.0f}", s.status)
        for s in inputs.clock.segments[:_MOST_ROWS]
    ]  # fmt: skip
    head = (
        "from / s", "to / s", "offset / ms", "sigma", "drift / ppm", "sigma", "angle / deg",
        "turned / deg", "status",
    )  # fmt: skip
    caption = "The robot's clock minus the ground truth's, by segment"
    content = [table(caption, head, rows, text=(8,))]
    notes = dict.fromkeys(s.note for s in inputs.clock.segments[:_MOST_ROWS] if s.note)
    content += [Part("note", f"Note: {note}.") for note in notes]
    left_out = len(inputs.clock.segments) - len(rows)
    if left_out > 0:
        content.append(Part("note", f"{left_out} more segments are in clock.json."))
    if any(math.isfinite(s.sigma_offset_s) for s in inputs.clock.segments):
        words = "The robot's clock minus the straight line through its segments."
        content.append(clock_figure(words, inputs.clock, inputs.ptpd))
    ptpd = inputs.documents.get("clock.json", {}).get("ptpd")
    if isinstance(ptpd, dict):
        figures = ", ".join(f"{k} {_value(v, 3)}" for k, v in ptpd.items())
        content.append(Part("text", f"ptpd: {figures}."))
    return content


def _rejected(inputs: Inputs) -> list[Part]:
    content: list[Part] = []
    laser = inputs.documents.get("laser.json", {})
    if sets := _entry(laser, "sets", dict):
        counts = ", ".join(f"{_value(number)} {status}" for status, number in sets.items())
        words = f"Sets of scans: {counts}. The lost ones include pauses between visits."
        content.append(Part("text", words))
    suspects = [str(s.get("name")) for s in _entries(laser, "scanners") if s.get("suspect")]
    if suspects:
        words = f"Scanners that disagree with the others: {', '.join(suspects)}."
        content.append(Part("problem", words))
    cameras = inputs.documents.get("camera.json", inputs.documents.get("poses.json", {}))
    if times := _entry(cameras, "times", dict):
        counts = ", ".join(f"{_value(number)} {status}" for status, number in times.items())
        words = f"Times of images: {counts}; squared residuals per degree of freedom "
        content.append(Part("text", f"{words}{_number(cameras.get('reduced_cost'), 1.0)}."))
    fused = inputs.documents.get("fused.json")
    if fused is None:
        return [*content, Part("note", "No results of a fusion (fused.json).")]
    rejected = _entries(fused, "rejected")
    used = ", ".join(f"{_value(v)} from {k}" for k, v in _entry(fused, "used", dict).items())
    restarts = _entry(fused, "restarts_s", list)
    words = f"Fusion used {used or 'nothing'}; rejected {len(rejected)}; {len(restarts)} restarts."
    content.append(Part("text", words))
    for key, what in (
        ("slips_s", "contradicts the measured poses, as after a slip of the wheels"),
        ("odometry_pauses_s", "pauses"),
        ("odometry_resets_s", "makes steps that no robot can make"),
    ):
        if spans := [span for span in _entry(fused, key, list) if isinstance(span, list)]:
            times = "; ".join(
                " to ".join(_number(t, 1.0, 3) for t in s) for s in spans[:_MOST_ROWS]
            )
            content.append(Part("problem", f"Odometry {what}, {len(spans)} times (s): {times}."))
    if rejected:
        worst = sorted(rejected, key=lambda r: -_float(r.get("squared_innovation")))[:_MOST_ROWS]
        entries = [
            (_number(r.get("time_s"), 1.0, 3), str(r.get("stream")),
             _number(r.get("squared_innovation"), 1.0, 1))
            for r in sorted(worst, key=lambda r: _float(r.get("time_s")))
        ]  # fmt: skip
        caption = "Poses rejected by the fusion"
        if len(rejected) > _MOST_ROWS:
            caption += f": the {_MOST_ROWS} worst of {len(rejected)}"
        head = ("t / s", "stream", "squared normalised distance")
        content.append(table(caption, head, entries, text=(1,)))
    return content


def _settings(inputs: Inputs, version: str) -> list[Part]:
    content = []
    for name, document in inputs.documents.items():
        # In a file of scanners, this is the version of the format.
        settings = _entry(document, "settings", dict).items()
        content.append(Part("text", f"{name}: version {_value(document.get('version'))}"))
        content.append(Part("list", rows=tuple((f"{k}: {_value(v)}",) for k, v in settings)))
    content.append(Part("text", f"Page written by groundtruth report, version {version}."))
    return content


def _entries(document: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """The objects of a list in an untrusted file."""
    return [entry for entry in _entry(document, key, list) if isinstance(entry, dict)]


def _entry(document: dict[str, Any], key: str, kind: type) -> Any:
    """An entry of an untrusted file, or an empty one if it is not of the expected kind."""
    value = document.get(key)
    return value if isinstance(value, kind) else kind()


def _value(value: Any, digits: int = 6) -> str:
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    return value if isinstance(value, str) else json.dumps(value)[:2000]


def _float(value: Any) -> float:
    return float(value) if is_number(value) else 0.0


def _number(value: Any, factor: float, decimals: int = 2) -> str:
    return f"{factor * value:.{decimals}f}" if is_number(value) else "-"
