"""Comparison of lines whose differences are known."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from math import pi
from pathlib import Path
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.cli import main
from detect.comparison.compare import compare_line_frames as compare
from detect.comparison.result import LineComparison
from detect.options import CompareOptions
from redetect.landmarks import CircleLandmark, Frame, Landmark, LineLandmark, Step, write_frames
from tests.detect.comparison.formatting import format_text

STANDARD = CompareOptions()


def line(
    alpha_deg: float,
    sigma_deg: float = 0.1,
    ids: tuple[int, ...] = (),
    beta_deg: float = 0.0,
    ends: tuple[float, float, float, float] = (0.1, -0.3, 0.1, 0.2),
) -> LineLandmark:
    return LineLandmark(
        *ends, np.radians(alpha_deg), np.radians(beta_deg), 0.0, np.radians(sigma_deg), ids
    )


def frame(name: str, *rows: Landmark) -> Frame:
    return Frame(Step(name, 0, 0, 0, 1e-6, 0, 1e-6, 0, 0, 1e-6), rows)


def compare_rows(
    reference: Sequence[LineLandmark],
    detected: Sequence[LineLandmark],
    options: CompareOptions = STANDARD,
) -> LineComparison:
    return compare([frame("e.0", *reference)], [frame("e.0", *detected)], options)


REFERENCE = [
    frame("e.0000", line(20, ids=(1,)), line(5, ids=(2,)), line(-10, ids=(-1,))),
    frame("e.0001", line(0, ids=(1,)), line(-20, ids=(3,))),
    frame("e.0002", line(7, ids=(1,))),
]
DETECTED = [
    # One off by 0.3 degrees, one missed, one without ID found, one extra.
    frame("e.0000", line(20.3), line(-10), line(30)),
    frame("e.0001", line(0.1), line(-20)),
]


def test_a_run_agrees_with_itself() -> None:
    found = compare(REFERENCE, REFERENCE)
    assert (found.reference, found.detected, found.matched, found.joined) == (6, 6, 6, 0)
    assert found.recall == found.precision == 1
    assert (found.bearing_95_deg, found.beta_median_deg, found.ends_median) == (0, 0, 0)
    assert found.normalised_error.per_dof == 0


def test_bearing_errors_are_differences_without_sign() -> None:
    offsets = [0.05, -0.1, 0.3, -0.45]
    reference = [line(10 * i) for i in range(4)]
    detected = [line(10 * i + offset) for i, offset in enumerate(offsets)]
    found = compare_rows(reference, detected)
    assert found.bearing_median_deg == pytest.approx(np.median(np.abs(offsets)))
    assert found.bearing_95_deg == pytest.approx(np.quantile(np.abs(offsets), 0.95))
    assert found.frames[0].largest_error == pytest.approx(0.45)


def test_ends_and_betas_are_compared_too() -> None:
    reference = [line(0), line(10, beta_deg=-1)]
    detected = [
        # The top end off by 0.03 and 0.04, the bottom end by 0.1.
        line(0, beta_deg=0.4, ends=(0.13, -0.34, 0.1, 0.3)),
        line(10, beta_deg=-1.2, ends=(0.1, -0.3, 0.1, 0.21)),
    ]
    found = compare_rows(reference, detected)
    assert found.ends_median == pytest.approx(np.median([0.05, 0.1, 0.0, 0.01]))
    assert found.beta_median_deg == pytest.approx(np.median([0.4, 0.2]))


@pytest.mark.parametrize(("first", "second"), [(179.9, -179.9), (-179.95, 179.85), (0.1, 359.9)])
def test_bearings_wrap_round_the_circle(first: float, second: float) -> None:
    found = compare_rows([line(first)], [line(second)])
    assert found.matched == 1
    assert found.bearing_median_deg == pytest.approx(0.2)
    assert found.normalised_error.per_dof == pytest.approx(4)


def test_a_joined_row_wraps_too() -> None:
    found = compare_rows([line(179.7), line(-179.8)], [line(179.9, sigma_deg=0.3)])
    assert (found.matched, found.joined, found.missed) == (1, 1, 0)


@pytest.mark.parametrize(
    ("options", "offset_deg", "sigma_deg", "matched"),
    [
        (STANDARD, 0.49, 0.01, True),
        (STANDARD, 0.51, 0.01, False),
        (STANDARD, 0.51, 0.26, True),
        (STANDARD, 0.79, 0.4, True),
        (STANDARD, 0.81, 0.4, False),
        (CompareOptions(tolerance_deg=0.1), 0.15, 0.01, False),
        (CompareOptions(tolerance_deg=1), 0.95, 0.01, True),
        (CompareOptions(sigmas=3), 1.15, 0.4, True),
        (CompareOptions(sigmas=0), 0.51, 0.4, False),
    ],
)
def test_the_gate_is_the_larger_of_tolerance_and_sigmas(
    options: CompareOptions, offset_deg: float, sigma_deg: float, matched: bool
) -> None:
    for sign in (-1, 1):
        found = compare_rows([line(3, 5.0)], [line(3 + sign * offset_deg, sigma_deg)], options)
        assert (found.matched == 1) == matched


def test_pairs_are_one_to_one_with_least_squares() -> None:
    # The nearest reference row of both is the second; only one of them can have it.
    found = compare_rows([line(0), line(0.4)], [line(0.3), line(0.5)])
    assert (found.matched, found.joined) == (2, 0)
    assert found.bearing_95_deg == pytest.approx(np.quantile([0.3, 0.1], 0.95))
    twice = compare_rows([line(0)], [line(0.1), line(-0.2)])
    assert (twice.matched, twice.extra) == (1, 1)
    assert twice.bearing_median_deg == pytest.approx(0.1)


def test_a_joined_row_finds_all_lines_within_its_sigmas() -> None:
    reference = [line(0), line(0.9), line(1.6), line(2.5)]
    found = compare_rows(reference, [line(0.8, sigma_deg=0.45)])
    # Its two sigmas reach from -0.1 to 1.7 degrees.
    assert (found.matched, found.joined, found.found, found.missed) == (1, 2, 3, 1)
    assert found.recall == pytest.approx(3 / 4)
    assert found.precision == 1
    assert found.bearing_95_deg == pytest.approx(0.1)
    score = found.frames[0]
    assert [len(rows) for rows in (score.matched, score.joined, score.missed, score.extra)] == [
        1,
        2,
        1,
        0,
    ]


def test_the_tolerance_joins_no_rows() -> None:
    found = compare_rows([line(0), line(0.4)], [line(0, sigma_deg=0.1)])
    assert (found.matched, found.joined, found.missed) == (1, 0, 1)


def test_joining_prefers_rows_of_their_own() -> None:
    found = compare_rows([line(0), line(0.5)], [line(0.3, sigma_deg=0.4), line(0.55)])
    assert (found.matched, found.joined, found.extra) == (2, 0, 0)


@pytest.mark.parametrize(("told", "expected"), [(0.1, 1.0), (0.05, 4.0), (0.2, 0.25)])
def test_normalised_error_tells_how_honest_sigma_is(told: float, expected: float) -> None:
    rng = np.random.default_rng(5)
    true_deg, error_deg = rng.uniform(-40, 40, 1000), rng.normal(0, 0.1, 1000)
    reference = [frame(f"e.{i}", line(alpha)) for i, alpha in enumerate(true_deg)]
    detected = [frame(f"e.{i}", line(alpha, told)) for i, alpha in enumerate(true_deg + error_deg)]
    found = compare(reference, detected).normalised_error
    assert found.dof == 1000
    assert found.per_dof == pytest.approx(expected, rel=0.12)
    assert found.band == pytest.approx((0.9143, 1.0895), abs=1e-3)  # chi-square, 1000 dof


@pytest.mark.parametrize("sigma_deg", [0.0, -0.3, 1e-300])
def test_sigmas_that_say_nothing_are_left_out_and_counted(sigma_deg: float) -> None:
    found = compare_rows([line(0), line(9)], [line(0.1, sigma_deg), line(9.2)])
    assert found.matched == 2
    error = found.normalised_error
    assert (error.dof, error.left_out) == (1, 1)
    assert error.per_dof == pytest.approx(4)
    text = " ".join(format_text(found).split())  # without line breaks
    assert "normalised error left out 1" in text


def test_discs_in_the_file_do_not_count() -> None:
    disc = CircleLandmark(0, -1, 0.9, 1e-3, 0, 1e-3)
    found = compare([frame("e.0", disc, line(0))], [frame("e.0", line(0), disc)])
    assert (found.reference, found.detected, found.matched) == (1, 1, 1)


@pytest.mark.parametrize(
    ("reference", "detected"),
    [([], []), (REFERENCE, []), ([], DETECTED), ([frame("e.0")], [frame("e.0")])],
)
def test_no_matches_give_clear_results(reference: list[Frame], detected: list[Frame]) -> None:
    found = compare(reference, detected)
    assert (found.matched, found.joined) == (0, 0)
    assert found.recall == (0 if found.reference else None)
    assert found.precision == (0 if found.detected else None)
    figures = json.loads(found.to_json())
    for name in ("bearing_median_deg", "bearing_95_deg", "ends_median", "beta_median_deg"):
        assert figures[name] is None
    assert "bearing median deg -" in " ".join(format_text(found).split())


def test_json_has_the_figures_in_a_fixed_order() -> None:
    found = json.loads(compare(REFERENCE, DETECTED).to_json())
    assert list(found) == list(json.loads(compare([], []).to_json()))
    assert (found["matched"], found["joined"], found["found"]) == (4, 0, 4)
    assert (found["missed"], found["extra"], found["frames"]) == (1, 1, 2)
    assert found["recall"] == pytest.approx(0.8)
    assert found["bearing_median_deg"] == pytest.approx(0.05)
    assert found["normalised_error"]["per_dof"] == pytest.approx((9 + 1) / 4)
    assert found["worst_frames"][0]["name"] == "e.0000"
    assert found["options"] == asdict(STANDARD)


def test_text_shows_the_figures_plainly() -> None:
    text = format_text(compare(REFERENCE, DETECTED))
    lines = [" ".join(row.split()) for row in text.splitlines()]
    assert lines[0] == "4 of 5 verticals of the reference are found, 1 missed, in 2 frames."
    figures = {"recall 0.8", "bearing median deg 0.05", "bearing 95 deg 0.27"}
    assert figures | {"e.0000 2 0 1 1 0.300"} <= {*lines}
    assert "\x1b" not in text
    assert max(map(len, text.splitlines())) <= 100


LINES = st.lists(
    st.builds(
        line,
        # Few values, so that ties, duplicates and the wrap occur.
        st.sampled_from([-180.0, -179.8, 0.0, 0.2, 0.3, 0.4, 0.8, 1.2, 179.7]) | st.floats(-2, 2),
        st.sampled_from([0.0, 0.1, 0.3, 0.6]),
        st.sampled_from([(), (-1,), (5,), (5, 6)]),
        st.sampled_from([0.0, 1.0]),
    ),
    max_size=6,
)
OPTIONS = st.builds(CompareOptions, only_identified=st.booleans())


@given(LINES, LINES, OPTIONS, st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(
    reference: list[LineLandmark],
    detected: list[LineLandmark],
    options: CompareOptions,
    random: Random,
) -> None:
    expected = compare_rows(reference, detected, options).to_json()
    random.shuffle(reference)
    random.shuffle(detected)
    assert compare_rows(reference, detected, options).to_json() == expected


@given(LINES, LINES, OPTIONS, st.floats(-pi, pi))
def test_rows_are_accounted_for_whatever_they_are(
    reference: list[LineLandmark],
    detected: list[LineLandmark],
    options: CompareOptions,
    turn_rad: float,
) -> None:
    found = compare_rows(reference, detected, options)
    counted = [row for row in reference if row.identified or not options.only_identified]
    assert found.reference == len(counted)
    assert found.detected + found.set_aside == len(detected)
    assert 0 <= found.matched <= min(found.reference, found.detected)
    assert 0 <= found.missed <= found.reference - found.matched
    assert found.joined == 0 or found.matched > 0
    json.loads(found.to_json())
    # Turning the robot changes no difference, so none larger than the widest gate appears.
    turned = [
        [replace(r, alpha=r.alpha + turn_rad) for r in rows] for rows in (reference, detected)
    ]
    largest = compare_rows(turned[0], turned[1], options).frames[0].largest_error
    assert largest is None or largest <= 1.2 + 1e-9


def test_rows_on_unlisted_lines_are_neither_right_nor_wrong(tmp_path: Path) -> None:
    reference, unlisted = [frame("a", line(0.0))], [frame("a", line(5.0), line(20.0))]
    detected = [frame("a", line(0.1), line(5.1), line(-30.0))]

    result = compare(reference, detected, unlisted=unlisted)

    assert (result.found, result.extra, result.set_aside) == (1, 1, 1)
    assert result.precision == 0.5
    assert "set aside 1" in " ".join(format_text(result).split())
    # So does the file beside the reference.
    for name, frames in (("map", reference), ("unlisted", unlisted), ("detected", detected)):
        write_frames(tmp_path / f"{name}.lines", frames)
    assert main(["compare", str(tmp_path), "--lines", "--json", str(tmp_path / "c.json")]) == 0
    assert json.loads((tmp_path / "c.json").read_text())["set_aside"] == 1
