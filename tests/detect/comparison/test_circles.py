"""Comparison of runs whose differences are known."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.comparison.compare import compare_frames as compare
from detect.comparison.compare import compare_run
from detect.errors import CompareError, DetectError
from detect.options import CompareOptions
from detect.sources.image_files import image_name
from redetect.landmarks import CircleLandmark, Frame, Step, read_frames, write_frames
from tests.detect.comparison.formatting import format_text

STANDARD = CompareOptions()


def disc(
    px: float, forward: float, quality: float = 0.9, ids: tuple[int, ...] = (), sigma: float = 0.04
) -> CircleLandmark:
    return CircleLandmark(px, -forward, quality, sigma**2, 0.0, sigma**2, ids)


def frame(name: str, *discs: CircleLandmark) -> Frame:
    return Frame(Step(name, 0, 0, 0, 1e-6, 0, 1e-6, 0, 0, 1e-6), discs)


REFERENCE = [
    frame("e.0000", disc(0, 1.0, 0.98, (1,)), disc(1, 2.2, 0.92, (2,)), disc(-1, 3.2, 0.8, (-1,))),
    frame("e.0001", disc(0.5, 1.2, 0.96, (1,)), disc(0.5, 2.7, 0.84, (3,))),
    frame("e.0002", disc(0, 1.7, 0.95, (1,))),
]
DETECTED = [
    # One off by 0.03 and 0.04 m, one missed, one without ID found, one extra.
    frame("e.0000", disc(0.03, 1.04, 0.97), disc(-1, 3.2, 0.7), disc(2, 2.2, 0.6)),
    frame("e.0001", disc(0.5, 1.21, 0.95), disc(0.5, 2.7, 0.83)),
]


def test_rows_are_matched_missed_or_extra() -> None:
    found = compare(REFERENCE, DETECTED)
    assert (found.reference, found.detected, found.matched) == (5, 5, 4)
    assert (found.missed, found.extra) == (1, 1)
    assert found.recall == found.precision == pytest.approx(4 / 5)
    assert found.frames_only_in_reference == ("e.0002",)
    assert found.frames_only_in_detected == ()


def test_rows_on_what_is_known_besides_are_told_apart() -> None:
    unlisted = (frame("e.0000", disc(2, 2.2, 1.0)),)
    lookalikes = (frame("e.0001", disc(-0.6, 1.9, 1.0), disc(3, 3, 1.0)),)
    detected = [
        frame("e.0000", *DETECTED[0].circles, disc(1.5, 1.5, 0.5)),
        frame("e.0001", *DETECTED[1].circles, disc(-0.6, 1.92, 0.9)),
    ]
    found = compare(REFERENCE, detected, STANDARD, unlisted=unlisted, lookalikes=lookalikes)
    assert (found.matched, found.missed, found.extra) == (4, 1, 2)
    assert (found.set_aside, found.on_lookalikes) == (1, 1)
    assert found.precision == pytest.approx(4 / 6)
    text = " ".join(format_text(found).split())
    assert "4 of 5 discs of the reference are found, 1 missed, in 2 frames." in text
    assert "1 are on things known to look like a disc, and 1 on nothing known." in text
    assert "4 of 6 detected rows" in text
    assert "1 more is on discs that the reference does not list." in text
    assert re.search(r"largest error mm .* e\.0000 \d \d \d \d+\.\d", text)
    assert "set aside 1" in text
    without = compare(REFERENCE, detected, STANDARD)
    assert (without.extra, without.set_aside, without.on_lookalikes) == (3, 0, None)
    assert " more " not in without.sentences()[1]


def test_a_reference_row_comes_before_an_unlisted_one() -> None:
    """An unlisted disc beside a listed one must not take its row."""
    unlisted = (frame("e.0000", disc(0.03, 1.04, 1.0)),)
    found = compare(REFERENCE, DETECTED, STANDARD, unlisted=unlisted)
    assert (found.matched, found.set_aside) == (4, 0)


def test_errors_are_distances_of_matched_rows() -> None:
    found = compare(REFERENCE, DETECTED)
    errors = [0.05, 0.0, 0.01, 0.0]
    assert found.error_median_m == pytest.approx(np.median(errors))
    assert found.error_95_m == pytest.approx(np.quantile(errors, 0.95))


def test_distance_bins_hold_each_row_once() -> None:
    found = compare(REFERENCE, DETECTED)
    by_start = {part.from_m: part for part in found.bins}
    near, middle = by_start[0.8], by_start[2.0]
    assert (near.reference, near.missed, near.detected, near.extra) == (2, 0, 2, 0)
    assert near.recall == near.precision == 1
    assert near.error_median_m == pytest.approx(0.03)
    assert (middle.reference, middle.missed, middle.detected, middle.extra) == (1, 1, 1, 1)
    assert (middle.recall, middle.precision, middle.error_median_m) == (0, 0, None)
    assert by_start[1.5].recall is None
    for total, part_counts in (
        (found.reference, [part.reference for part in found.bins]),
        (found.missed, [part.missed for part in found.bins]),
        (found.detected, [part.detected for part in found.bins]),
        (found.extra, [part.extra for part in found.bins]),
    ):
        assert sum(part_counts) == total


@pytest.mark.parametrize(("forward", "bin_start"), [(0.1, None), (1.5, 1.5), (4.0, 4.0), (9, 4.0)])
def test_a_bin_begins_with_its_first_edge(forward: float, bin_start: float | None) -> None:
    frames = [frame("e.0", disc(0, forward))]
    (part,) = (part for part in compare(frames, frames).bins if part.reference)
    assert part.from_m == bin_start


def test_only_identified_rows_count_on_demand() -> None:
    found = compare(REFERENCE, DETECTED, CompareOptions(only_identified=True))
    # The detection on the row without ID is neither right nor wrong.
    assert (found.reference, found.detected, found.matched, found.set_aside) == (4, 4, 3, 1)
    assert found.extra == 1


def test_a_row_without_id_takes_no_detection_from_one_with() -> None:
    reference = [frame("e.0", disc(0, 1, ids=(1,)), disc(0.02, 1, ids=(-1,)))]
    detected = [frame("e.0", disc(0.02, 1))]
    found = compare(reference, detected, CompareOptions(only_identified=True))
    assert (found.matched, found.extra, found.set_aside) == (1, 0, 0)


def test_frames_of_one_file_do_not_count() -> None:
    extra_frame = frame("e.0009", disc(0, 1), disc(1, 1))
    detected = [*DETECTED, extra_frame]
    without = compare(REFERENCE, detected)
    assert without.frames_only_in_detected == ("e.0009",)
    assert (without.missed, without.extra) == (1, 1)
    assert without.frames_only_in_reference == ("e.0002",)


def test_the_gate_is_a_distance() -> None:
    reference = [frame("e.0", disc(0, 2))]

    def matched(px: float, forward: float, options: CompareOptions) -> bool:
        return compare(reference, [frame("e.0", disc(px, forward))], options).matched == 1

    assert matched(0.06, 2.06, STANDARD)
    assert not matched(0.08, 2.08, STANDARD)
    assert matched(0.08, 2.08, CompareOptions(gate_m=0.12))


@pytest.mark.parametrize("gate", [0.0, -1.0, float("nan"), float("inf")])
def test_gates_must_be_positive(gate: float) -> None:
    with pytest.raises(CompareError, match=r"gate_m is .*: expected above 0"):
        CompareOptions(gate_m=gate)


@pytest.mark.parametrize(("told", "expected"), [(0.01, 1.0), (0.005, 4.0), (0.02, 0.25)])
def test_normalised_error_tells_how_honest_the_covariance_is(told: float, expected: float) -> None:
    rng = np.random.default_rng(11)
    reference, detected = [], []
    for index in range(500):
        true_x, error = rng.uniform(-1, 1), rng.normal(0, 0.01, 2)
        reference.append(frame(f"e.{index}", disc(true_x, 2.0)))
        detected.append(frame(f"e.{index}", disc(true_x + error[0], 2.0 + error[1], sigma=told)))
    error_squared = compare(reference, detected).normalised_error
    assert error_squared.dof == 1000
    assert error_squared.per_dof == pytest.approx(expected, rel=0.1)
    assert error_squared.band == pytest.approx((0.9143, 1.0895), abs=1e-3)  # chi-square, 1000 dof


def test_improper_covariances_are_left_out_and_counted() -> None:
    reference = [frame("e.0", disc(0, 1), disc(1, 1))]
    detected = [frame("e.0", disc(0.04, 1), disc(1.02, 1, sigma=0.0))]
    found = compare(reference, detected).normalised_error
    assert (found.dof, found.left_out) == (2, 1)
    assert found.per_dof == pytest.approx(0.5)
    none_usable = compare(reference, [frame("e.0", disc(1.02, 1, sigma=0.0))]).normalised_error
    assert (none_usable.per_dof, none_usable.band, none_usable.left_out) == (None, None, 1)


@pytest.mark.parametrize(
    ("prefix", "name"),
    [
        ("dlr-spatial_cognition-e.0067", "dlr-spatial_cognition-e.0067"),
        ("images/e.0067.jpg", "e.0067"),
        ("/data/run\\images\\e.0067.PPM", "e.0067"),
        ("e.0067", "e.0067"),
        (".png", ".png"),
        ("shot.final", "shot.final"),
    ],
)
def test_images_are_known_by_their_names(prefix: str, name: str) -> None:
    assert image_name(prefix) == name


def test_frames_are_matched_by_image_name_in_any_order() -> None:
    renamed = [
        replace(f, step=replace(f.step, prefix=f"images/{f.step.prefix}.jpg")) for f in DETECTED
    ]
    found = compare(REFERENCE, renamed[::-1])
    assert found.matched == compare(REFERENCE, DETECTED).matched == 4


def test_an_image_may_have_one_frame_only() -> None:
    twice = [frame("e.0001"), frame("images/e.0001.png")]
    with pytest.raises(CompareError, match=r"detected: two frames of image 'e\.0001'"):
        compare(REFERENCE, twice)
    with pytest.raises(CompareError, match=r"reference: two frames of image 'e\.0001'"):
        compare(twice, DETECTED)


def test_worst_frames_come_first() -> None:
    reference = [
        frame("good", disc(0, 1)),
        frame("far", disc(0, 1)),
        frame("bad", disc(0, 1), disc(1, 1)),
        frame("worst", disc(0, 1), disc(1, 1)),
    ]
    detected = [
        frame("good", disc(0.01, 1)),
        frame("far", disc(0.09, 1)),
        frame("bad", disc(0, 1)),
        frame("worst", disc(0.5, 1)),
    ]
    found = compare(reference, detected)
    worst = found.worst_frames(3)
    assert [score.name for score in worst] == ["worst", "bad", "far"]
    assert [len(rows) for rows in (worst[0].matched, worst[0].missed, worst[0].extra)] == [0, 2, 1]
    assert worst[0].largest_error is None
    assert worst[2].largest_error == pytest.approx(0.09)


@pytest.mark.parametrize(
    ("reference", "detected"),
    [([], []), (REFERENCE, []), ([], DETECTED), ([frame("e.0")], [frame("e.0")])],
)
def test_no_matches_give_clear_results(reference: list[Frame], detected: list[Frame]) -> None:
    found = compare(reference, detected)
    assert found.matched == 0
    assert found.error_median_m is None
    assert found.normalised_error.per_dof is None
    assert found.recall == (0 if found.reference else None)
    assert found.precision == (0 if found.detected else None)
    assert json.loads(found.to_json())["error_95_m"] is None
    text = " ".join(format_text(found).split())
    assert "error median m -" in text
    assert "There are no errors: no rows match." in text
    assert "0 of 0" not in text


def test_json_has_the_figures_in_a_fixed_order() -> None:
    found = json.loads(compare(REFERENCE, DETECTED).to_json())
    empty = json.loads(compare([], []).to_json())
    assert list(found) == list(empty)
    assert found["matched"] == 4
    assert found["missed"] == found["extra"] == 1
    assert found["frames"] == 2
    assert found["frames_only_in_reference"] == ["e.0002"]
    assert found["recall"] == pytest.approx(0.8)
    assert found["worst_frames"][0]["name"] == "e.0000"
    assert found["options"]["gate_m"] == 0.1


def test_text_shows_the_figures_plainly() -> None:
    text = format_text(compare(REFERENCE, DETECTED))
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert lines[0] == "4 of 5 discs of the reference are found, 1 missed, in 2 frames."
    assert {"found 4", "extra 1", "recall 0.8", "extra beyond 0"} <= {*lines}
    (middle,) = (line for line in text.splitlines() if line.strip().startswith("2-2.5"))
    assert " ".join(middle.split()) == "2-2.5 1 1 0.000 1 1 0.000 -"
    assert "\x1b" not in text
    assert max(map(len, text.splitlines())) <= 100


def test_no_heading_is_cut_off_in_a_usual_terminal() -> None:
    text = format_text(compare(REFERENCE, DETECTED), width=80)
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
    assert max(map(len, text.splitlines())) <= 80


def test_text_escapes_what_a_terminal_would_obey() -> None:
    strange = [frame("[red]e\x1b[31m\udcfc", disc(0, 1))]
    text = format_text(compare(strange, strange))
    assert r"[red]e\x1b[31m\udcfc" in text
    text.encode("utf-8")


def test_runs_are_compared_by_their_files(tmp_path: Path) -> None:
    write_frames(tmp_path / "map.circles", REFERENCE)
    text = (tmp_path / "map.circles").read_bytes()
    (tmp_path / "map.circles").write_bytes(text.replace(b"\n", b"\r\n"))
    write_frames(tmp_path / "detected.circles", DETECTED)
    found = compare_run(tmp_path)
    assert (found.matched, found.missed, found.extra) == (4, 1, 1)
    assert found.reference_name == str(tmp_path / "map.circles")
    sides = tmp_path / "detected.circles", tmp_path / "map.circles"
    swapped = compare_run(tmp_path, reference=sides[0], detected=sides[1])
    assert (swapped.matched, swapped.missed, swapped.extra) == (4, 1, 1)
    strict = compare_run(tmp_path, options=CompareOptions(gate_m=0.001))
    assert strict.matched == 2
    write_frames(tmp_path / "no.lines", [])
    for files in ((sides[1], tmp_path / "no.lines"), (tmp_path / "no.lines", sides[1])):
        with pytest.raises(CompareError, match=r"circles: its rows are circles: expected lines"):
            compare_run(tmp_path, "lines", *files)
    write_frames(tmp_path / "other.circles", [frame("f.0000"), frame("f.0001")])
    for other in (tmp_path / "other.circles", tmp_path / "no.lines"):
        with pytest.raises(CompareError, match=r"^no image is in both .*map.circles and "):
            compare_run(tmp_path, detected=other)
    (tmp_path / "detected.circles").unlink()
    with pytest.raises(DetectError, match=r"detected\.circles: no such landmark file"):
        compare_run(tmp_path)


DISCS = st.lists(
    st.builds(
        disc,
        st.floats(-0.5, 0.5),
        st.floats(0.5, 1.5),
        st.floats(0, 1),
        st.sampled_from([(), (-1,), (5,)]),
    ),
    max_size=6,
)


@given(DISCS, DISCS, st.booleans())
def test_rows_are_accounted_for_whatever_they_are(
    reference: list[CircleLandmark], detected: list[CircleLandmark], only_identified: bool
) -> None:
    options = CompareOptions(only_identified=only_identified)
    found = compare([frame("e", *reference)], [frame("e", *detected)], options)
    counted = [row for row in reference if row.identified or not only_identified]
    assert found.reference == len(counted)
    assert found.detected + found.set_aside == len(detected)
    assert 0 <= found.matched <= min(found.reference, found.detected)
    assert sum(part.reference for part in found.bins) == found.reference
    json.loads(found.to_json())


def test_the_shipped_file_agrees_with_itself(shared_data: Path) -> None:
    frames = list(read_frames(shared_data / "dlr" / "map.circles"))
    found = compare(frames, frames)
    assert (found.matched, found.missed, found.extra) == (14745, 0, 0)
    assert found.error_95_m == 0
