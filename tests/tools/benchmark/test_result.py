"""What is reported follows from what was measured."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest

from tools.benchmark.errors import BenchmarkError
from tools.benchmark.functions import DECODING, Measured
from tools.benchmark.machine import Machine, cpu_model, this_machine
from tools.benchmark.plot import plot_png
from tools.benchmark.report import format_headline, format_markdown, number, spliced
from tools.benchmark.result import (
    GrowthPoint,
    KindTimes,
    Result,
    comparisons,
    costs_per_landmark,
    format_json,
    function_times,
    growth_powers,
    run_times,
    times_one_job_beyond,
)

_MEASURED = [
    Measured(DECODING, "decoding", lambda p: p),
    Measured("own", "circles", lambda p: p),
    Measured("cv2 LSD", "peer", lambda p: p),
]
_SECONDS = {
    DECODING: np.array([[0.001, 0.002], [0.003, 0.004]]),
    "own": np.array([[0.004, 0.006], [0.006, 0.004]]),
    "cv2 LSD": np.array([[0.040, np.nan], [0.030, np.nan]]),
}


def _result() -> Result:
    functions = function_times(_MEASURED, _SECONDS)
    kind = KindTimes("demo", "frames", 2, functions, comparisons([("cv2 LSD", "own")], _SECONDS))
    passes = [
        run_times(
            "detect all",
            10,
            jobs,
            np.array([2.0, 2.0, 4.0]) / jobs,
            np.full(3, 0.5),
            np.full(3, 0.6),
            np.array([2.0, 2.0, 4.0]),
        )
        for jobs in (1, 2)
    ]
    points = tuple(GrowthPoint(amount, functions) for amount in (0.2, 0.9))
    return Result(
        machine=Machine("A processor", 2, "Linux", {"python": "3"}),
        settings={"pictures": 2, "rounds": 7, "jobs": (1, 2)},
        absent=("something",),
        skipped=("photographs: no folder was given",),
        kinds=(kind,),
        runs=tuple(passes),
        by_megapixels=points,
        by_discs=points,
        by_verticals=points,
        by_frames=tuple(passes),
    )


def test_times_and_ratios_are_medians_of_calls_and_of_pairs() -> None:
    own = function_times(_MEASURED, _SECONDS)[1]
    assert own.ms.median == pytest.approx(5.0)
    assert own.ms.least == pytest.approx(4.0)
    # The pairs' ratios are 4, 3, 2, 1; the ratio of the medians would be 2.
    assert own.decodings.median == pytest.approx(2.5)
    assert (own.decodings.lower_quartile, own.decodings.upper_quartile) == (1.75, 3.25)


def test_decoding_takes_as_long_as_decoding() -> None:
    decoding = function_times(_MEASURED, _SECONDS)[0]
    assert decoding.decodings.lower_quartile == decoding.decodings.upper_quartile == 1.0


def test_peers_are_compared_where_both_were_measured() -> None:
    found = comparisons([("cv2 LSD", "own"), ("absent", "own")], _SECONDS)
    assert [c.slower for c in found] == ["cv2 LSD"]
    assert found[0].ratio.median == pytest.approx(7.5)  # of 10 and 5
    assert found[0].ratio.count == 2


def test_the_share_of_decoding_is_per_job() -> None:
    decoding = np.array([0.2, 0.4, 0.8])
    times = run_times("detect all", 100, 2, np.array([1.0, 2.0, 4.0]), decoding, 1.5 * decoding)
    assert times.images_per_s.median == pytest.approx(50.0)
    # Decoding alone runs at 500, 250, 125 images per second, two jobs at 50, 25, 12.5 each.
    assert times.share_of_decoding.median == pytest.approx(0.1)
    assert times.share_of_decoding.least == pytest.approx(0.1)
    assert times.share_of_reading.median == pytest.approx(0.15)


def test_jobs_are_compared_with_one_in_the_same_round() -> None:
    one, two = np.array([4.0, 4.0, 9.0]), np.array([2.0, np.nan, 5.0])
    decoding = np.ones(3)
    times = run_times("detect all", 100, 2, two, decoding, decoding, one)
    assert times.times_one_job is not None
    assert times.times_one_job.median == pytest.approx(1.9)
    assert times.times_one_job.count == 2
    assert run_times("detect all", 100, 2, two, decoding, decoding).times_one_job is None


def test_what_several_jobs_do_once_they_have_begun() -> None:
    """A job takes 2 s for a thousand frames; two begin after 3 s and take 1.25 s."""
    once = np.ones(1)
    runs = [
        run_times("detect all", frames, jobs, seconds * once, once, once)
        for frames in (1000, 4000)
        for jobs, seconds in ((1, 0.002 * frames), (2, 3.0 + 0.00125 * frames))
    ]
    beyond = times_one_job_beyond(runs, 2)
    assert beyond is not None
    assert beyond[0] == 1000
    assert beyond[1] == pytest.approx(1.6)
    assert times_one_job_beyond(runs[:2], 2) is None
    assert times_one_job_beyond(runs, 3) is None


def test_json_holds_all_of_it() -> None:
    document = json.loads(format_json(_result()))
    assert set(document) == {
        "machine", "settings", "absent", "skipped", "kinds", "runs",
        "by_megapixels", "by_discs", "by_verticals", "by_frames",
    }  # fmt: skip
    function = document["kinds"][0]["functions"][1]
    assert function["name"] == "own"
    assert function["decodings"] == {
        "median": 2.5, "lower_quartile": 1.75, "upper_quartile": 3.25, "least": 1.0, "count": 4,
    }  # fmt: skip
    assert document["by_frames"][1]["images_per_s"]["median"] == 10.0
    assert document["by_megapixels"][1]["amount"] == 0.9


def test_markdown_tells_ratios_first_and_what_is_missing() -> None:
    text = format_markdown(_result())
    assert "| own | 2.50 (1.75 - 3.25); 5.00 ms |" in text
    assert "| cv2 LSD / own | 7.50 (6.25 - 8.75) |" in text
    assert (
        "| `detect all`, 10 frames | 2 | 10.0 | 0.25 (0.19 - 0.25) | 0.30 (0.22 - 0.30) |" in text
    )
    assert "| *decoding from memory* | 1 | 20.0 | 1 |  |" in text
    assert "| *reading and decoding files* | 1 | 16.7 |  | 1 |" in text
    assert "| frames | jobs: 1 | jobs: 2 |" in text
    assert "| 10 | 5.00 | 10.0 (2.00) |" in text
    assert "settings: pictures 2, rounds 7, jobs 1 2" in text
    assert "not installed: something" in text
    assert "not measured: photographs: no folder was given" in text


def test_growth_is_that_of_known_laws() -> None:
    def points(law: Callable[[float], float]) -> list[GrowthPoint]:
        seconds = {amount: np.full((1, 1), law(amount) / 1e3) for amount in (0.5, 1.0, 4.0)}
        return [
            GrowthPoint(amount, function_times(_MEASURED[:1], {DECODING: taken}))
            for amount, taken in seconds.items()
        ]

    assert growth_powers(points(lambda n: 3.0 * n**1.5)) == {DECODING: pytest.approx(1.5)}
    bare, each = costs_per_landmark(points(lambda n: 5.0 + 0.25 * n))[DECODING]
    assert bare == pytest.approx(5.0)
    assert each == pytest.approx(0.25)
    # What does not grow: a slope of exactly 0, on some processors at least.
    assert growth_powers(points(lambda n: 1.0)) == {DECODING: 0.0}
    _, each = costs_per_landmark(points(lambda n: 5.0))[DECODING]
    assert each == pytest.approx(0.0, abs=1e-12)


def test_the_headline_is_medians_alone() -> None:
    text = format_headline(_result())
    assert "| x decoding (ms) | demo |" in text
    assert "| own | 2.50 (5.00) |" in text
    assert "5.00 images/s, 0.25 of decoding from memory, 0.30 of reading and decoding" in text
    assert "(10 frames; decoding alone 20.0 images/s, with reading 16.7)" in text
    assert "`detect all` of 10 frames with 2 jobs 10.0 images/s, 2.00 times one job." in text
    assert "A processor; 2 pictures of each kind, 7 rounds." in text


def test_the_table_replaces_the_one_that_stands_there() -> None:
    document = "a\n<!-- benchmark begins -->\nold\n<!-- benchmark ends -->\nb\n"
    once = spliced(document, "new\n")
    assert once == "a\n<!-- benchmark begins -->\nnew\n<!-- benchmark ends -->\nb\n"
    assert spliced(once, "new\n") == once


@pytest.mark.parametrize(
    "document",
    [
        "nothing",
        "<!-- benchmark begins -->",
        "<!-- benchmark ends --><!-- benchmark begins -->",
        "<!-- benchmark begins --><!-- benchmark begins --><!-- benchmark ends -->",
    ],
)
def test_a_document_without_a_place_for_the_table_is_an_error(document: str) -> None:
    with pytest.raises(BenchmarkError, match="no place"):
        spliced(document, "new")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1458.2, "1,458"),
        (99.96, "100"),
        (12.34, "12.3"),
        (9.996, "10.0"),
        (1.0, "1.00"),
        (0.0712, "0.071"),
        (0.0041, "0.0041"),
    ],
)
def test_numbers_keep_two_or_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_the_plot_is_a_picture() -> None:
    import cv2

    picture = cv2.imdecode(np.frombuffer(plot_png(_result()), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape == (850, 1300, 3)
    assert np.ptp(picture) == 255


def test_the_processor_is_the_one_that_the_system_names() -> None:
    assert cpu_model("processor\t: 0\nmodel name\t: A: B\nmodel\t: 7\n") == "A: B"
    assert cpu_model("nothing of the kind") == ""
    machine = this_machine()
    assert machine.cores >= 1
    assert machine.versions["numpy"] == np.__version__
