"""Several runs of one building in one map: from their files to places, paths and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.landmarks import LineLandmark, squared_mahalanobis, write_frames
from redetect.landmarks.map_file import read_map, read_path, with_joint_covariance
from redetect.plane import apply, between, invert
from redetect.slam.association.loops import Submap
from redetect.slam.association.registration import register_maps
from redetect.slam.association.run import associate_run
from redetect.slam.association.scoring import score_association
from redetect.slam.cli import main
from redetect.slam.models import disc_in_robot
from redetect.slam.recording import Recording, frames_of_discs, joined, read_recording
from tests.slam.test_associate_runs import (
    LINE_SIGMA,
    NO_LINES,
    circuit,
    drive,
    ids_of,
    scattered,
    with_clutter,
)

DEMO = Path(__file__).parents[2] / "images" / "e"
DISCS = scattered(3, 45, 0.5, 5.0)
# The first run begins at a corner, the second elsewhere, and both go round more than once.
PATHS = circuit(1.2, 5.0), circuit(2.0, 5.0)[70:]


def write_run(file: Path, run: Recording, *, known: bool) -> str:
    """A run as a landmark file, with the simulation's identifiers or without."""
    rows = run.circles if known else replace(run.circles, ids=0 * run.circles.ids - 1)
    frames = frames_of_discs(replace(run, circles=rows))
    lines = run.lines
    for k, bearing, ids in zip(lines.frame, lines.bearing_rad, lines.ids):
        line = LineLandmark(0.0, -1.0, 0.0, 1.0, float(bearing), 0.0, 0.0, LINE_SIGMA, ids)
        frames[k] = replace(frames[k], landmarks=(*frames[k].landmarks, line))
    write_frames(file, frames, head="simulated")
    return str(file)


@pytest.fixture(scope="module")
def runs() -> list[Recording]:
    return [drive(path, DISCS, NO_LINES, seed) for seed, path in enumerate(PATHS)]


def check_map(folder: Path, true_ids: dict[int, int]) -> None:
    """Places and paths are where they truly are in the first run's frame, as far as they say."""
    found = read_map(folder / "map.csv").discs
    true = disc_in_robot(PATHS[0][0], DISCS)[[true_ids[i] for i in found.ids.tolist()]]
    off = found.xy - true
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.15
    joint = with_joint_covariance(read_map(folder / "map.csv"), folder / "map.csv").joint_covariance
    assert joint is not None
    squared = off.ravel() @ np.linalg.solve(joint, off.ravel())
    assert squared / off.size == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / off.size))
    for k, path in enumerate(PATHS, 1):
        read = read_path(folder / f"path_{k}.csv")
        assert read.prefixes[:2] == ("start", "s.0")
        away = read.poses[:, :2] - between(PATHS[0][0], path)[:, :2]
        assert np.sqrt(np.mean(np.sum(away**2, axis=1))) < 0.15
        assert read.covariance is not None
        squares = squared_mahalanobis(away[1:], read.covariance[1:, :2, :2])
        assert 0.2 < np.mean(squares) / 2.0 < 2.5  # poses share most of their error


def test_runs_without_identifiers_get_one_set_and_one_map(
    runs: list[Recording], tmp_path: Path
) -> None:
    files = [write_run(tmp_path / f"{k}.circles", run, known=False) for k, run in enumerate(runs)]
    assert main(["associate", *files, "-o", str(tmp_path / "found.circles")]) == 0
    named = [tmp_path / f"found_{k}.circles" for k in (1, 2)]
    true_ids: dict[int, int] = {}
    seen_by: list[set[int]] = []
    for file, run in zip(named, runs):
        ids = read_recording(file).circles.ids
        seen_by.append(set(ids[ids > 0].tolist()))
        for number, true in zip(ids.tolist(), run.circles.ids.tolist()):
            if number > 0:
                assert true_ids.setdefault(number, true) == true  # no false join
    assert len(set(true_ids.values())) == len(true_ids)  # and no disc in two
    assert len(seen_by[0] & seen_by[1]) > 30
    assert main(["map", *map(str, named), "-o", str(tmp_path / "map")]) == 0
    check_map(tmp_path / "map", true_ids)


def test_runs_are_registered_though_most_labels_are_clutter(runs: list[Recording]) -> None:
    cluttered = joined([with_clutter(run, len(run.circles) // 3, 7) for run in runs])
    found = associate_run(cluttered)
    assert len(np.unique(found.local_circle_labels)) > 4 * len(DISCS)
    score = score_association(found.circle_labels, ids_of(cluttered))
    assert score.pair_precision > 0.999
    assert score.pair_recall > 0.9


def test_runs_whose_identifiers_agree_are_mapped_at_once(
    runs: list[Recording], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [write_run(tmp_path / f"{k}.circles", run, known=True) for k, run in enumerate(runs)]
    assert main(["map", *files, "-o", str(tmp_path / "map")]) == 0
    check_map(tmp_path / "map", {i: i for i in range(len(DISCS))})
    assert "path_1.csv, path_2.csv" in capsys.readouterr().out
    # The second start is measured by nothing.
    whole = joined(runs)
    known = 3 * len(whole.steps) - 3 + 2 * len(whole.circles)
    unknown = 3 * len(whole.steps) + 2 * len(np.unique(whole.circles.ids))
    assert f'"expected": {known - unknown},' in (tmp_path / "map" / "table.json").read_text()


def test_runs_that_were_numbered_apart_are_refused(
    runs: list[Recording], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each run's discs are numbered from 0 in the order of first sight."""
    files = []
    for k, run in enumerate(runs):
        _, first, order = np.unique(run.circles.ids, return_index=True, return_inverse=True)
        ids = np.argsort(np.argsort(first))[order]
        apart = replace(run, circles=replace(run.circles, ids=ids))
        files.append(write_run(tmp_path / f"{k}.circles", apart, known=True))
    assert main(["map", *files, "-o", str(tmp_path / "both")]) == 1
    assert (
        "the same identifiers: expected common ones, as `slam associate" in capsys.readouterr().err
    )
    assert not (tmp_path / "both").exists()


@pytest.mark.parametrize("discs", [DISCS, DISCS[:0]], ids=["with discs", "alone"])
def test_verticals_of_runs_whose_identifiers_agree_are_one(
    tmp_path: Path, discs: FloatArray
) -> None:
    """Where the second run lies is said by its discs, or by the verticals alone."""
    lines = scattered(5, 25, 1.0, 5.0)
    runs = [drive(path, discs, lines, seed) for seed, path in enumerate(PATHS)]
    files = [write_run(tmp_path / f"{k}.circles", run, known=True) for k, run in enumerate(runs)]
    camera = ["--camera", str(DEMO / "e.cam")]
    assert main(["map", *files, *camera, "-o", str(tmp_path / "map")]) == 0
    found = read_map(tmp_path / "map" / "map.csv").lines
    assert len(found) >= 18
    first, second = (np.bincount(np.ravel(run.lines.ids), minlength=25) for run in runs)
    assert np.all(np.minimum(first, second)[found.ids] > 0)
    np.testing.assert_array_equal(found.rows, (first + second)[found.ids])
    off = found.xy - disc_in_robot(PATHS[0][0], lines)[found.ids]
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.12


def test_a_run_of_another_building_is_refused(
    runs: list[Recording], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = drive(PATHS[1], scattered(8, 45, 0.5, 5.0), NO_LINES, 2)
    other = replace(other, circles=replace(other.circles, ids=other.circles.ids + 1000))
    files = [
        write_run(tmp_path / f"{k}.circles", run, known=True)
        for k, run in ((1, runs[0]), (2, other))
    ]
    assert main(["associate", *files, "-o", str(tmp_path / "found.circles")]) == 1
    assert f"{files[1]}: the frames from start on cannot be" in capsys.readouterr().err
    assert not list(tmp_path.glob("found*"))
    assert main(["map", *files, "-o", str(tmp_path / "map")]) == 1
    said = capsys.readouterr().err
    assert f"{files[0]}, {files[1]}: disconnected at step" in said
    assert "(start): odometry is lost or another run begins there, and the parts" in said


def test_maps_lie_where_they_are_certain_to() -> None:
    """One that only a third joins to the first; none in a room of which there are two."""
    rng = np.random.default_rng(1)
    discs = rng.uniform(0.0, [30.0, 6.0], (120, 2))
    true = np.array([[0.0, 0.0, 0.0], [5.0, 2.0, 2.0], [-3.0, 1.0, -1.0]])
    places, submaps = [], []
    for pose, (low, high) in zip(true, ((0.0, 12.0), (18.0, 30.0), (6.0, 24.0))):
        seen = discs[(discs[:, 0] > low) & (discs[:, 0] < high)]
        places.append(apply(invert(pose), seen + rng.normal(0.0, 0.02, seen.shape)))
        labels = np.argsort(seen[:, 0])
        parts = np.array_split(labels, 2 if high - low < 15.0 else 3)
        submaps.append([Submap(25, np.sort(p), places[-1][np.sort(p)]) for p in parts])
    motions, pairs, apart = register_maps(places, submaps)
    assert apart == []
    np.testing.assert_allclose(motions, true, atol=0.1)
    everywhere = np.concatenate([apply(m, p) for m, p in zip(motions, places)])
    gaps = [np.linalg.norm(everywhere[a] - everywhere[b], axis=1) for a, b in (p.T for p in pairs)]
    assert sum(map(len, gaps)) > 40
    assert max(map(max, gaps)) < 0.15
    twins = np.concatenate([places[0], places[0] + [0.0, 20.0]])
    assert register_maps([twins, places[2]], [[], submaps[2]])[2] == [1]
