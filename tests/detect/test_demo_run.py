"""The demo run, and any run given by ``--run``, re-detected and held against its shipped rows."""

from __future__ import annotations

from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import pytest

from detect.comparison.compare import compare_frames, compare_line_frames
from detect.comparison.result import DiscComparison, LineComparison
from detect.line_settings import LineSettings
from detect.options import CompareOptions
from detect.runs.plan import FramePlan, FramesByImage, Job, Priors, RunSummary
from detect.runs.stream import detect_run
from detect.settings import PUBLISHED, REPORT, CircleSettings
from detect.sources.opening import open_run
from redetect.landmarks import read_frames

#: What the shipped rows were detected with, apart from what makes one disc one row.
LIKE_SHIPPED = replace(CircleSettings(), polarity="light", far_limit=PUBLISHED.far_limit)


def detected(
    run: Path, settings: CircleSettings, output: Path, known: Path | None = None, crlf: bool = False
) -> RunSummary:
    """The discs of a run, with the IDs of known rows."""
    opened = open_run(run)
    plan = FramePlan(opened.camera, circles=settings)
    ids = Priors() if known is None else Priors(discs=FramesByImage(known))
    return detect_run(Job(opened, plan, {"circles": output}, ids, crlf=crlf))


def redetected(run: Path, settings: CircleSettings, folder: Path) -> DiscComparison:
    output = folder / "detected.circles"
    summary = detected(run, settings, output)
    assert summary.failures == []
    reference = read_frames(run / "map.circles")
    return compare_frames(reference, read_frames(output), CompareOptions(gate_m=0.3))


@pytest.mark.long
def test_demo_run_is_found_again(project_root: Path, tmp_path: Path) -> None:
    result = redetected(project_root / "images" / "e", LIKE_SHIPPED, tmp_path)
    assert result.matched + result.missed >= 250
    assert (result.recall or 0.0) >= 0.97
    assert (result.precision or 0.0) >= 0.80


@pytest.mark.long
def test_reports_detector_finds_the_demo_run(project_root: Path, tmp_path: Path) -> None:
    result = redetected(project_root / "images" / "e", REPORT, tmp_path)
    assert (result.recall or 0.0) >= 0.98


def rows_of(path: Path) -> list[bytes]:
    """The lines of a landmark file from the first STEP on."""
    lines = path.read_bytes().splitlines(keepends=True)
    first = next(k for k, line in enumerate(lines) if line.startswith(b"STEP"))
    return lines[first:]


@pytest.mark.long
def test_given_runs_come_out_byte_for_byte(given_runs: list[Path], tmp_path: Path) -> None:
    """The published detector is the one that shipped rows were made with: all, and only those."""
    for number, run in enumerate(given_runs):
        output = tmp_path / f"{number}.circles"
        shipped = rows_of(run / "map.circles")
        crlf = shipped[0].endswith(b"\r\n")
        summary = detected(run, PUBLISHED, output, run / "map.circles", crlf)
        assert summary.failures == []
        differing = [
            (ours, theirs)
            for ours, theirs in zip_longest(rows_of(output), shipped)
            if ours != theirs
        ]
        assert differing == []


#: The least share of the rows with an ID that the default detector finds again.
LEAST_RECALL = 0.985


@pytest.mark.long
def test_default_finds_given_runs_again(given_runs: list[Path], tmp_path: Path) -> None:
    """A row is found again where a detected one gets its ID, or several of them."""
    for number, run in enumerate(given_runs):
        output = tmp_path / f"{number}.circles"
        reference = FramesByImage(run / "map.circles")
        detected(run, CircleSettings(), output, run / "map.circles")
        wanted = found = 0
        for frame in read_frames(output):
            own = {identifier for row in frame.circles for identifier in row.ids} - {-1}
            rows = reference.get(frame.step.prefix)
            known = [] if rows is None else [row.ids for row in rows.circles]
            named = [ids for ids in known if ids and ids != (-1,)]
            wanted += len(named)
            found += sum(not own.isdisjoint(ids) for ids in named)
        assert wanted > 0
        assert found / wanted >= LEAST_RECALL, f"{run}: {found} of {wanted} rows"


def redetected_lines(run: Path, folder: Path) -> LineComparison:
    output = folder / "detected.lines"
    opened = open_run(run)
    plan = FramePlan(opened.camera, lines=LineSettings())
    summary = detect_run(Job(opened, plan, {"lines": output, "tilt": folder / "detected.tilt"}))
    assert summary.failures == []
    return compare_line_frames(read_frames(run / "map.lines"), read_frames(output))


@pytest.mark.long
def test_verticals_of_the_demo_run_are_found_again(project_root: Path, tmp_path: Path) -> None:
    result = redetected_lines(project_root / "images" / "e", tmp_path)
    # The truth lists every vertical with a step of 12 grey values over 20 rows, however far from
    # the horizon: many are too short for the detector.
    assert (result.recall or 0.0) >= 0.6
    assert 0.0 < (result.bearing_median_deg or 0.0) <= 0.03
    assert 0.0 < (result.bearing_95_deg or 0.0) <= 0.2


@pytest.mark.long
def test_verticals_of_given_runs_are_found_again(given_runs: list[Path], tmp_path: Path) -> None:
    runs = [run for run in given_runs if (run / "map.lines").is_file()]
    if not runs:
        pytest.skip("no run folder with map.lines was given by --run")
    for number, run in enumerate(runs):
        folder = tmp_path / str(number)
        folder.mkdir()
        result = redetected_lines(run, folder)
        assert (result.recall or 0.0) >= 0.5, f"{run}: recall {result.recall}"
