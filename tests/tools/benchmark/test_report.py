"""What is reported follows from what was measured."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pytest

from tools.benchmark.report import (
    Result,
    cpu_model,
    format_markdown,
    number,
    plot_png,
    run_time,
    this_machine,
    times_of,
)

_SECONDS = {
    "decoding": np.array([[0.001, 0.002], [0.003, 0.004]]),
    "own": np.array([[0.004, 0.006], [0.006, 0.004]]),
    "cv2 LSD": np.array([[0.040, np.nan], [0.030, np.nan]]),
}


def _result() -> Result:
    seconds = np.array([2.0, 2.0, 4.0])
    alone = [np.full(3, 0.5), np.full(3, 0.6)]
    runs = [run_time("detect all", 10, jobs, seconds / jobs, alone, seconds) for jobs in (1, 2)]
    cases = [("images", "demo"), *((p, a) for p in ("megapixels", "discs") for a in ("0.2", "0.9"))]
    times = [time for case in cases for time in times_of(*case, _SECONDS, "decoding")]
    settings = {"pictures": 2, "rounds": 7, "jobs": (1, 2)}
    return Result("A processor", settings, tuple(times), tuple(runs))


def test_times_and_ratios_are_medians_of_calls_and_of_pairs() -> None:
    decoding, own, _ = times_of("images", "demo", _SECONDS, "decoding")
    assert own.ms.median == pytest.approx(5.0)
    assert own.ms.least == pytest.approx(4.0)
    # The pairs' ratios are 4, 3, 2, 1; the ratio of the medians would be 2.
    assert own.decodings.median == pytest.approx(2.5)
    assert (own.decodings.lower_quartile, own.decodings.upper_quartile) == (1.75, 3.25)
    assert decoding.decodings.lower_quartile == decoding.decodings.upper_quartile == 1.0


def test_the_share_of_decoding_is_per_job() -> None:
    decoding = np.array([0.2, 0.4, 0.8])
    alone = [decoding, 1.5 * decoding]
    times = run_time("detect all", 100, 2, np.array([1.0, 2.0, 4.0]), alone)
    assert times.images_per_s.median == pytest.approx(50.0)
    # Decoding alone runs at 500, 250, 125 images per second, two jobs at 50, 25, 12.5 each.
    assert times.share_of_decoding.median == pytest.approx(0.1)
    assert times.share_of_decoding.least == pytest.approx(0.1)
    assert times.share_of_reading.median == pytest.approx(0.15)


def test_jobs_are_compared_with_one_in_the_same_round() -> None:
    one, two = np.array([4.0, 4.0, 9.0]), np.array([2.0, np.nan, 5.0])
    alone = [np.ones(3), np.ones(3)]
    times = run_time("detect all", 100, 2, two, alone, one)
    assert times.times_one_job is not None
    assert times.times_one_job.median == pytest.approx(1.9)
    assert times.times_one_job.count == 2
    assert run_time("detect all", 100, 2, two, alone).times_one_job is None


def test_json_holds_all_of_it() -> None:
    document = json.loads(json.dumps(asdict(_result())))
    assert set(document) == {"machine", "settings", "times", "runs"}
    own = document["times"][1]
    assert (own["part"], own["case"], own["function"]) == ("images", "demo", "own")
    assert own["decodings"] == {
        "median": 2.5, "lower_quartile": 1.75, "upper_quartile": 3.25, "least": 1.0, "count": 4,
    }  # fmt: skip
    assert document["runs"][1]["images_per_s"]["median"] == 10.0


def test_markdown_has_ratios_first() -> None:
    text = format_markdown(_result())
    assert "| own | 2.50 (1.75 - 3.25); 5.00 ms |" in text
    assert "|  | 0.2 | 0.9 |" in text
    assert (
        "| `detect all` | 10 | 2 | 10.0 | 0.25 (0.19 - 0.25) | 0.30 (0.22 - 0.30) | 2.00 "
        "| 20.0 | 16.7 |"
    ) in text
    assert "settings: pictures 2, rounds 7, jobs 1 2" in text


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
    assert f"numpy {np.__version__}" in this_machine()
