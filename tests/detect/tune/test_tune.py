"""Grids of parameters, their curve and its knee, and the command that tries them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera import read_camera, write_camera
from detect.cli import main
from detect.commands.tune import (
    combinations,
    curve_picture,
    knee,
    marked,
    parameter_values,
    pareto_front,
)
from detect.errors import DetectError
from detect.projection import leaning_camera
from detect.settings import CircleSettings
from tests.detect.commands import Captured, assert_refused
from tests.detect.conftest import SMALL_RUN_DISCS

# -- curve and knee ---------------------------------------------------------------------------

# Recall, precision; the last three are beaten by others.
CURVE = [(0.50, 1.0), (0.90, 0.95), (0.95, 0.70), (1.0, 0.4), (0.90, 0.94), (0.4, 0.99), (0.6, 0.5)]


def test_front_and_knee_of_a_curve_made_by_hand() -> None:
    recall, precision = np.array(CURVE).T
    assert pareto_front(recall, precision).tolist() == [0, 1, 2, 3]
    assert knee(recall, precision) == 1


def test_equal_settings_are_there_once() -> None:
    assert pareto_front([0.5, 0.5, 0.7], [0.8, 0.8, 0.6]).tolist() == [0, 2]


def test_without_a_bend_the_greatest_f1_stands_for_the_knee() -> None:
    # Hollow: every point is below the chord.
    assert knee([0.1, 0.5, 1.0], [1.0, 0.2, 0.1]) == 1
    assert knee([0.9, 0.3], [0.8, 0.9]) == 0
    assert knee([0.4], [0.5]) == 0
    assert knee([np.nan, 0.5], [0.5, np.nan]) is None


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12))
def test_front_is_what_nothing_beats(points: list[tuple[int, int]]) -> None:
    recall = np.array([r / 6 for r, _ in points])
    precision = np.array([p / 6 for _, p in points])
    front = pareto_front(recall, precision)
    unbeaten = {
        (r, p)
        for r, p in points
        if not any((a >= r and b > p) or (a > r and b >= p) for a, b in points)
    }
    assert [points[k] for k in front] == sorted(unbeaten)
    chosen = knee(recall, precision)
    assert (chosen is None) == (not points)
    assert chosen is None or chosen in front


# -- grids ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("threshold", "0.3:0.7:0.1", (0.3, 0.4, 0.5, 0.6, 0.7)),
        ("threshold", "0.4:0.6:0.15", (0.4, 0.55)),
        ("threshold", "0.5", (0.5,)),
        ("threshold", "0.5, 0.2,0.5", (0.5, 0.2)),
        ("samples", "8:16:4", (8, 12, 16)),
        ("refine", "true,False", (True, False)),
        ("polarity", "light,any", ("light", "any")),
        ("evidence", "-1,2.5", (-1.0, 2.5)),
    ],
)
def test_values_of_a_parameter(name: str, text: str, expected: tuple[object, ...]) -> None:
    values = parameter_values(name, text)
    assert values == expected
    assert [type(v) for v in values] == [type(v) for v in expected]


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("radius", "1", "radius is not a parameter of CircleSettings: .* radius_m"),
        ("least_rows", "1", "not a parameter of CircleSettings"),
        ("threshold", "0.3:0.7", "FROM:TO:STEP"),
        ("threshold", "0.7:0.3:0.1", "FROM:TO:STEP"),
        ("threshold", "0.3:0.7:0", "FROM:TO:STEP"),
        ("threshold", "0:inf:1", "FROM:TO:STEP"),
        ("threshold", "a:b:c", "FROM:TO:STEP"),
        ("threshold", "0:1e999999:1e-999999", "FROM:TO:STEP"),
        ("threshold", "much", "expected a number"),
        ("samples", "8:9:0.5", "expected a whole number"),
        ("refine", "maybe", "True or False"),
        ("polarity", "grey", "any, light, dark"),
    ],
)
def test_values_that_are_none_are_refused(name: str, text: str, says: str) -> None:
    with pytest.raises(DetectError, match=says):
        parameter_values(name, text)


def test_all_combinations_are_tried() -> None:
    grid = combinations({"threshold": "0.4,0.5", "samples": "8,16"})
    assert [replace(CircleSettings(), **c) for c in grid] == [
        CircleSettings(threshold=t, samples=s) for t in (0.4, 0.5) for s in (8, 16)
    ]
    with pytest.raises(DetectError, match="nothing is varied"):
        combinations({})
    with pytest.raises(DetectError, match="1010101 combinations of values: expected at most"):
        combinations({"evidence": "0:1:0.0001", "threshold": "0:1:0.01"})


# -- tables and pictures ----------------------------------------------------------------------


def test_records_mark_front_and_knee() -> None:
    trials = [{"threshold": k / 10, "recall": r, "precision": p} for k, (r, p) in enumerate(CURVE)]
    records = marked(trials)
    assert [r["front"] for r in records] == [True] * 4 + [False] * 3
    assert [r["knee"] for r in records] == [False, True] + [False] * 5
    picture = curve_picture(records, ["threshold"], "by hand")
    assert picture == curve_picture(records, ["threshold"], "by hand")
    shown = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    # The ring round the knee (#a8321e).
    assert (np.abs(shown.astype(int) - (0x1E, 0x32, 0xA8)).sum(axis=2) < 30).sum() > 50


# -- the command ------------------------------------------------------------------------------


def write_reference(
    run: Path, discs: dict[str, list[tuple[float, float]]], name: str = "map"
) -> None:
    rows = []
    for prefix, places in discs.items():
        rows.append(f"STEP {prefix} 0 0 0 0 0 0 0 0 0")
        rows += [f"LANDMARK_C {x} {y} 0.9 1e-4 0 1e-4 1" for x, y in places]
    (run / f"{name}.circles").write_text("\n".join(rows) + "\n")


def test_trials_are_what_detecting_and_comparing_gives(small_run: Path, tmp_path: Path) -> None:
    # Of the three discs one need not be found, and one of the reference is not in the image.
    write_reference(
        small_run, {**SMALL_RUN_DISCS, "s.0001": [], "s.0002": [(0.0, -1.4), (0.5, -1.4)]}
    )
    write_reference(small_run, {"s.0001": SMALL_RUN_DISCS["s.0001"]}, "unlisted")
    folder, compared = tmp_path / "t", tmp_path / "c.json"
    arguments = ["tune", str(small_run), "--vary", "samples=8,16", "--vary", "threshold=0.4,0.999"]
    arguments += ["--vary", "refine=false"]
    assert main([*arguments, "-o", str(folder)]) == 0
    document = json.loads((folder / "table.json").read_text())
    rows = document["trials"]
    assert [(r["threshold"], r["samples"]) for r in rows] == [
        (0.4, 8), (0.999, 8), (0.4, 16), (0.999, 16),
    ]  # fmt: skip
    assert (rows[2]["recall"], rows[2]["precision"]) == (0.5, 1.0)
    for row in rows:
        flags = ["--quality-threshold", str(row["threshold"]), "--samples", str(row["samples"])]
        flags.append("--no-refine")
        assert main(["circles", str(small_run), *flags, "--force"]) == 0
        assert main(["compare", str(small_run), "--json", str(compared), "--force"]) == 0
        expected = json.loads(compared.read_text())
        for name in ("reference", "detected", "matched", "recall", "precision"):
            assert row[name] == pytest.approx(expected[name], rel=1e-5)
    assert document["varied"] == {
        "samples": "8,16", "threshold": "0.4,0.999", "refine": "false",
    }  # fmt: skip
    assert document["settings"]["radius_m"] == 0.1
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert main([*arguments, "-o", str(folder), "--force"]) == 0
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.long
def test_covariances_have_the_usual_tilt_of_the_run(project_root: Path, tmp_path: Path) -> None:
    """As those of `detect circles`, which examines some images for it."""
    run, rows, compared = project_root / "images" / "e", tmp_path / "c.circles", tmp_path / "c.json"
    leaning = leaning_camera(read_camera(run / "e.cam"), (0.01, 0.0))
    write_camera(leaning, tmp_path / "leaning.cam")
    some = [str(run), "--camera", str(tmp_path / "leaning.cam")]
    default = f"evidence={CircleSettings().evidence}"
    trials = ["tune", *some, "--frames", "20", "--vary", default]
    assert main([*trials, "-o", str(tmp_path / "t")]) == 0
    (trial,) = json.loads((tmp_path / "t" / "table.json").read_text())["trials"]
    assert main(["circles", *some, "--frames", "20", "-o", str(rows)]) == 0
    assert main(["compare", *some, "--detected", str(rows), "--json", str(compared)]) == 0
    expected = json.loads(compared.read_text())["normalised_error"]["per_dof"]
    assert trial["normalised_error"] == pytest.approx(expected, rel=1e-3)


@pytest.mark.long
def test_a_trial_does_not_depend_on_the_others(project_root: Path, tmp_path: Path) -> None:
    """Each setting has its own look at some images: with other discs, the tilt is another."""
    run = project_root / "images" / "e"
    trials: dict[str, list[dict[str, object]]] = {}
    for radii in ("0.1", "0.05,0.1"):
        place = tmp_path / radii
        some = ["--every", "20", "--vary", f"radius_m={radii}", "-o", str(place)]
        assert main(["tune", str(run), *some]) == 0
        trials[radii] = json.loads((place / "table.json").read_text())["trials"]
    (alone,), (_, beside) = trials.values()
    del alone["knee"], alone["front"], beside["knee"], beside["front"]
    assert alone == beside


@pytest.mark.long
def test_processes_give_the_same_bytes(small_run: Path, tmp_path: Path) -> None:
    write_reference(small_run, SMALL_RUN_DISCS)
    arguments = ["tune", str(small_run), "--vary", "evidence=-0.5:0.5:0.5"]
    for jobs in ("1", "2"):
        assert main([*arguments, "--jobs", jobs, "-o", str(tmp_path / jobs)]) == 0
    for name in ("table.json", "curve.png"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def test_refusals(small_run: Path, tmp_path: Path, capsys: Captured) -> None:
    run = str(small_run)
    tune = ["tune", run, "-o", str(tmp_path / "t")]
    assert_refused(tune, small_run, "nothing is varied", capsys)
    assert_refused([*tune, "--vary", "threshold"], small_run, "expected NAME=VALUES", capsys)
    twice = ["--vary", "threshold=0.4", "--vary", "samples=8", "threshold=0.5"]
    assert_refused([*tune, *twice], small_run, "expected each parameter once", capsys)
    by_hand = [*tune, "--serve", "--vary", "samples=8"]
    assert_refused(by_hand, small_run, "--serve and --vary: expected one of them", capsys)
    idle = [*tune, "--vary", "threshold=0.5", "refine=true", "samples=8"]
    assert_refused(idle, small_run, "--vary samples threshold: without effect", capsys)
    assert_refused([*tune, "--vary", "evidence=0.5"], small_run, "map.circles", capsys)
    write_reference(small_run, {"other": [(0.0, -1.0)]})
    assert_refused([*tune, "--vary", "evidence=0.5"], small_run, "none of the 3", capsys)
    write_reference(small_run, SMALL_RUN_DISCS)
    assert_refused([*tune, "--vary", "threshold=2"], small_run, "threshold is 2", capsys)
    assert not (tmp_path / "t").exists()
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / "curve.png").write_bytes(b"mine")
    assert_refused([*tune, "--vary", "evidence=0.5"], small_run, "--force", capsys)
    with pytest.raises(SystemExit) as ended:
        main([*tune, "--treshold", "0.5"])
    assert ended.value.code == 2
    assert "--treshold" in capsys.readouterr().err
