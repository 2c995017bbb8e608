"""Measuring in turn, with a clock whose every tick is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tools.benchmark.timing import LEAST_CALLS, decodings, measure_in_turn, number, spread


class Machine:
    """Functions that take a known time on a machine whose load is known."""

    def __init__(self) -> None:
        self.now = 0.0
        self.load = 1.0
        self.calls: list[tuple[str, int]] = []

    def clock(self) -> float:
        return self.now

    def function(self, name: str, *seconds: float) -> Callable[[int], object]:
        def call(image: int) -> None:
            self.calls.append((name, image))
            self.now += self.load * seconds[image]

        return call


def test_times_and_ratios_are_medians_of_calls_and_of_pairs() -> None:
    seconds = {
        "decoding": np.array([[0.001, 0.002], [0.003, 0.004]]),
        "own": np.array([[0.004, 0.006], [0.006, 0.004]]),
        "slow": np.array([[0.040, np.nan], [0.030, np.nan]]),
    }
    found = decodings(seconds, "decoding")
    # The pairs' ratios are 4, 3, 2, 1; the ratio of the medians would be 2.
    assert spread(found["own"]) == "2.50 (1.75 - 3.25)"
    assert spread(found["decoding"]) == "1.00 (1.00 - 1.00)"
    assert spread(found["slow"]) == "25.0 (17.5 - 32.5)"
    assert [of["ms"] for of in found.values()] == pytest.approx([2.5, 5.0, 35.0])


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


def test_every_function_gets_every_image_in_every_round_and_its_own_time() -> None:
    machine = Machine()
    functions = {"a": machine.function("a", 1.0, 2.0), "b": machine.function("b", 10.0, 30.0)}
    seconds = measure_in_turn(functions, 2, 3, 1e9, machine.clock)
    np.testing.assert_array_equal(seconds["a"], [[1.0, 2.0]] * 3)
    np.testing.assert_array_equal(seconds["b"], [[10.0, 30.0]] * 3)


def test_functions_take_turns_and_each_comes_first() -> None:
    machine = Machine()
    functions = {name: machine.function(name, 1.0, 1.0, 1.0) for name in "abc"}
    measure_in_turn(functions, 3, 1, 1e9, machine.clock)
    warm_up, measured = machine.calls[:3], machine.calls[3:]
    assert warm_up == [("a", 0), ("b", 0), ("c", 0)]
    assert [image for _, image in measured] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert "".join(name for name, _ in measured) == "abcbcacab"


def test_the_first_call_is_not_measured() -> None:
    machine = Machine()
    times = iter([100.0, 1.0, 1.0])

    def compiled_on_first_call(_: int) -> None:
        machine.now += next(times)

    seconds = measure_in_turn({"a": compiled_on_first_call}, 1, 2, 1e9, machine.clock)
    np.testing.assert_array_equal(seconds["a"], [[1.0], [1.0]])


def test_a_slow_function_is_left_out_once_its_time_is_used_up() -> None:
    machine = Machine()
    functions = {"slow": machine.function("slow", 2.0), "fast": machine.function("fast", 0.1)}
    seconds = measure_in_turn(functions, 1, 10, 7.0, machine.clock)
    assert np.count_nonzero(~np.isnan(seconds["slow"])) == 4  # 2, 4, 6 are below 7; 8 is not
    assert np.count_nonzero(~np.isnan(seconds["fast"])) == 10


def test_a_function_slower_than_its_time_is_still_called_some_times() -> None:
    machine = Machine()
    functions = {"slow": machine.function("slow", 2.0)}
    seconds = measure_in_turn(functions, 1, 10, 0.0, machine.clock)
    assert np.count_nonzero(~np.isnan(seconds["slow"])) == LEAST_CALLS


def test_what_needs_no_warming_up_is_measured_from_its_first_call() -> None:
    machine = Machine()
    functions = {"slow": machine.function("slow", 2.0)}
    seconds = measure_in_turn(functions, 1, 10, 0.0, machine.clock, warm_up=False, least_calls=1)
    assert machine.calls == [("slow", 0)]
    assert np.count_nonzero(~np.isnan(seconds["slow"])) == 1


def test_load_cancels_out_of_ratios() -> None:
    machine = Machine()
    rng = np.random.default_rng(3)

    def on_a_loaded_machine(name: str, *own: float) -> Callable[[int], object]:
        call = machine.function(name, *own)

        def loaded(image: int) -> None:
            # The load changes from round to round, by a factor of up to ten.
            if len(machine.calls) % 4 == 0:
                machine.load = float(rng.uniform(1.0, 10.0))
            call(image)

        return loaded

    functions = {
        "decoding": on_a_loaded_machine("decoding", 1.0, 2.0),
        "detector": on_a_loaded_machine("detector", 4.0, 8.0),
    }
    # The warm-up's two calls put the changes of load between images.
    seconds = measure_in_turn(functions, 2, 20, 1e9, machine.clock)
    assert np.ptp(seconds["detector"]) > 10.0
    assert spread(decodings(seconds, "decoding")["detector"]) == "4.00 (4.00 - 4.00)"
