"""The tilt of a run: simulated sequences, whose true tilt is known, come back."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from camera import Camera
from camera.model_checks import checked_pose
from detect.run_tilt import (
    COMMON_RAD,
    FrameTilts,
    RunTilt,
    camera_pitch_weights,
    tilt_of_run,
    usual_tilt,
)
from detect.settings import LEAST_FRAMES

FloatArray = NDArray[np.float64]
FRAMES = 600
LEAN = np.radians([-2.4, 0.7])


def sequence(
    seed: int, spread: float = 0.3, strays: float = 0.02, jumps: float = 0.02
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """True tilts, measured ones and their stated variances.

    Half of the variance of an error lasts from frame to frame as scenes do. `spread` is that of the
    true tilts (degrees); `strays` and `jumps` are how often a measurement is of something else, and
    how often the robot tilts for a moment.
    """
    rng = np.random.default_rng(seed)
    sigma = np.radians(rng.uniform(0.05, 0.6, (FRAMES, 2)))
    true, lasting = np.empty((2, FRAMES, 2))
    x, u = np.zeros(2), np.zeros(2)
    for k in range(FRAMES):
        x = 0.7 * x + math.sqrt(1 - 0.7**2) * np.radians(spread) * rng.standard_normal(2)
        u = 0.9 * u + math.sqrt(1 - 0.9**2) * rng.standard_normal(2)
        true[k], lasting[k] = LEAN + x, u
    jump = rng.random(FRAMES) < jumps
    true[jump] += np.radians(2.0) * rng.standard_normal((int(jump.sum()), 2))
    measured = true + sigma * (lasting + rng.standard_normal((FRAMES, 2))) / math.sqrt(2.0)
    stray = rng.random(FRAMES) < strays
    measured[stray] += np.radians(2.0) * rng.standard_normal((int(stray.sum()), 2))
    measured[rng.random(FRAMES) < 0.05] = np.nan
    return true, measured, sigma**2


def found_tilt(
    verticals: FrameTilts, outlines: FrameTilts | None = None, common: FloatArray | None = None
) -> RunTilt:
    run = tilt_of_run(verticals, outlines, common)
    assert run is not None
    return run


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("spread", [0.2, 0.5])
@pytest.mark.parametrize(("strays", "jumps"), [(0.0, 0.0), (0.02, 0.03)])
def test_errors_are_as_large_as_stated(
    seed: int, spread: float, strays: float, jumps: float
) -> None:
    true, measured, variance = sequence(seed, spread, strays, jumps)
    run = found_tilt(FrameTilts(measured, variance))
    # The simulated lens has no error that all verticals share.
    normalised = np.mean((run.tilt - true) ** 2 / (run.variance - COMMON_RAD**2), axis=0)
    assert np.all((normalised > 0.3) & (normalised < 2.0)), normalised
    assert np.all(np.abs(run.lean - LEAN) < 3.0 * run.lean_sigma)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_is_nearer_than_the_frames_and_than_the_constant(seed: int) -> None:
    true, measured, variance = sequence(seed)
    run = found_tilt(FrameTilts(measured, variance))
    error = np.sqrt(np.nanmean((run.tilt - true) ** 2))
    assert error < 0.75 * np.sqrt(np.nanmean((measured - true) ** 2))
    assert error < 0.9 * np.sqrt(np.mean((run.lean - true) ** 2))


@pytest.mark.parametrize("spread", [0.1, 0.5])
@pytest.mark.parametrize("lean", [np.zeros(2), LEAN])
def test_usual_tilt_is_that_of_the_frames(spread: float, lean: FloatArray) -> None:
    true, measured, variance = sequence(4, spread)
    true, measured = true + lean - LEAN, measured + lean - LEAN
    run = found_tilt(FrameTilts(measured, variance))
    # The lens may add to the lean what it does to all verticals.
    least = math.sqrt(np.mean(true**2))
    assert 0.95 * least < run.usual_rad < 1.2 * math.hypot(least, COMMON_RAD)


def test_verticals_that_lean_together_are_not_believed() -> None:
    """Trunks in view for twenty frames, by three degrees, and not sure of it."""
    true, measured, variance = sequence(4, strays=0.0, jumps=0.0)
    measured[300:320, 0] += np.radians(3.0)
    variance[300:320] = np.radians(1.0) ** 2
    run = found_tilt(FrameTilts(measured, variance))
    assert np.degrees(np.abs(run.tilt - true)[300:320, 0]).max() < 1.5


def test_a_sill_is_followed() -> None:
    """One frame that is two degrees off, and sure of it: a wheel is on a sill."""
    true, measured, variance = sequence(5, strays=0.0, jumps=0.0)
    true[300, 0] += np.radians(2.0)
    measured[300] = true[300]
    variance[300] = np.radians(0.1) ** 2
    run = found_tilt(FrameTilts(measured, variance))
    assert np.degrees(abs(run.tilt[300, 0] - true[300, 0])) < 1.0
    # A stray would look the same: the error that is stated allows for it.
    assert np.degrees(np.sqrt(run.variance[300, 0])) > 0.5


def test_too_few_frames_have_no_run() -> None:
    measured = np.full((50, 2), np.nan)
    measured[: LEAST_FRAMES - 1] = 0.01

    assert tilt_of_run(FrameTilts(measured, np.full((50, 2), 1e-6))) is None


def test_to_a_camera_that_looks_aside_roll_is_its_pitch(published_camera: Camera) -> None:
    """A wrong height changes the roll of a robot by the outlines of discs at its side."""
    for bearing_deg, own in ((0.0, (1.0, 0.0)), (-90.0, (0.0, -1.0)), (180.0, (-1.0, 0.0))):
        turn = Rotation.from_euler("z", bearing_deg, degrees=True).as_matrix()
        pose = checked_pose("sensor2World", turn @ published_camera.robot_from_camera)
        assert camera_pitch_weights(
            replace(published_camera, robot_from_camera=pose)
        ) == pytest.approx(own)
    true, measured, variance = sequence(2)
    nothing = FrameTilts(np.full_like(true, np.nan), variance)
    outlines = FrameTilts(measured, variance)
    aside = FrameTilts(measured[:, ::-1], variance[:, ::-1])
    ahead = found_tilt(nothing, outlines)
    turned = tilt_of_run(nothing, aside, pitch_weights=(0.0, 1.0))
    assert turned is not None
    np.testing.assert_allclose(turned.lean, ahead.lean[::-1], atol=1e-4)
    np.testing.assert_allclose(turned.lean_sigma, ahead.lean_sigma[::-1], rtol=0.01)
    assert ahead.lean_sigma[0] > 2.0 * ahead.lean_sigma[1]


@pytest.mark.parametrize("count", [5, 10, 19])
@pytest.mark.parametrize("of_outlines", [False, True])
@pytest.mark.parametrize("tilt_deg", [0.2, 1.5])
def test_few_tilts_determine_an_unknown_one(count: int, of_outlines: bool, tilt_deg: float) -> None:
    rng = np.random.default_rng(count)
    nothing = np.full((40, 2), np.nan)
    found = []
    for _ in range(200):
        sigma = np.radians(rng.uniform(0.1, 0.6, (40, 2)))
        tilt = np.radians(tilt_deg) * rng.standard_normal((40, 2))
        tilt += sigma * rng.standard_normal((40, 2))
        tilt[count:] = np.nan
        both = FrameTilts(tilt, sigma**2), FrameTilts(nothing, nothing)
        found.append(math.degrees(usual_tilt(*(both[::-1] if of_outlines else both))))
    assert min(found) == pytest.approx(0.3) or tilt_deg > 1.0
    assert 0.5 < np.mean(found) / max(tilt_deg, 0.3) < 1.3


def test_two_strays_do_not_determine_an_unknown_tilt() -> None:
    tilt = np.full((40, 2), np.nan)
    tilt[[3, 17]] = np.radians([[4.0, -1.0], [1.0, 5.0]])
    both = (
        FrameTilts(tilt, np.full((40, 2), np.radians(0.3) ** 2)),
        FrameTilts(*2 * [tilt * np.nan]),
    )
    assert math.degrees(usual_tilt(*both)) < 0.5


@pytest.mark.parametrize("wrong", ["verticals", "outlines", "both"])
def test_the_lean_is_between_those_of_verticals_and_outlines(wrong: str) -> None:
    """A lens makes all verticals wrong, a height all outlines: a run does not show which it is."""
    true, measured, variance = sequence(6, spread=0.5, jumps=0.05)
    rng = np.random.default_rng(7)
    sigma = np.radians(0.1)
    outlines = true + sigma * rng.standard_normal(true.shape)
    outlines[::7] = np.nan
    off = np.radians([1.0, -0.5])
    measured = measured - off * {"verticals": 1.0, "outlines": 0.0, "both": 0.5}[wrong]
    outlines = outlines + off * {"verticals": 0.0, "outlines": 1.0, "both": 0.5}[wrong]
    alone = found_tilt(FrameTilts(measured, variance))
    run = found_tilt(
        FrameTilts(measured, variance), FrameTilts(outlines, np.full(true.shape, sigma**2))
    )
    assert np.all(np.abs(run.lean - LEAN) < 0.5 * np.abs(off) + np.radians(0.1))
    assert np.all(np.abs(run.lean - LEAN) < 2.0 * run.lean_sigma)
    # Frames' deviations are nearer to the truth than by the verticals alone.
    spread, spread_alone = (np.std(r.tilt - true, axis=0) for r in (run, alone))
    assert np.all(spread < 0.8 * spread_alone)
    normalised = np.mean((run.tilt - true) ** 2 / run.variance)
    assert normalised < 2.5


@pytest.mark.parametrize("with_verticals", [0, LEAST_FRAMES - 1])
@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_without_verticals_the_outlines_level(seed: int, stated: bool, with_verticals: int) -> None:
    """A camera that looks down; a wrong height adds to the pitch of all outlines."""
    true, measured, variance = sequence(seed, spread=0.5, strays=0.0, jumps=0.0)
    true, measured = true - 0.8 * LEAN, measured - 0.8 * LEAN
    rng = np.random.default_rng(seed)
    sigma = np.radians(0.2)
    outlines = true + sigma * rng.standard_normal(true.shape)
    outlines[:, 0] += np.radians(0.5 if stated else 1.0) * rng.uniform(-1.0, 1.0)
    outlines[::7] = np.nan
    measured[with_verticals:] = np.nan
    run = found_tilt(
        FrameTilts(measured, variance),
        FrameTilts(outlines, np.full(true.shape, sigma**2)),
        np.zeros(2) if stated else None,
    )
    assert not run.by_verticals
    assert "outlines" in run.sentence(1.4)
    assert np.all(np.abs(run.lean - 0.2 * LEAN) < 2.5 * run.lean_sigma)
    assert np.all(np.std(run.tilt - true, axis=0) < 0.6 * np.std(true, axis=0))
    assert np.all(np.mean((run.tilt - true) ** 2 / run.variance, axis=0) < 2.5)
    if with_verticals:  # their frames do not depend on the height
        some = slice(0, with_verticals)
        assert run.variance[some, 0].mean() < 0.7 * run.variance[with_verticals:, 0].mean()


def test_few_outlines_are_left_out() -> None:
    true, measured, variance = sequence(8)
    outlines = np.full(true.shape, np.nan)
    outlines[: LEAST_FRAMES - 5] = 0.5
    run = found_tilt(FrameTilts(measured, variance), FrameTilts(outlines, variance))
    alone = found_tilt(FrameTilts(measured, variance))
    np.testing.assert_array_equal(run.tilt, alone.tilt)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("factor", [0.3, 1.0])
def test_how_good_verticals_are_is_learned_by_outlines(seed: int, factor: float) -> None:
    """A frame by itself cannot know how true a building's verticals are: errors are `factor`."""
    true, measured, variance = sequence(seed, spread=0.4, strays=0.0, jumps=0.0)
    measured = true + factor * (measured - true)
    sigma = np.radians(0.3)
    outlines = true + sigma * np.random.default_rng(seed).standard_normal(true.shape)
    stated = FrameTilts(outlines, np.full(true.shape, (2.0 * sigma) ** 2))
    run = found_tilt(FrameTilts(measured, variance), stated)
    # Outlines and verticals agree, and no lens is wrong here.
    assert np.all(run.lean_sigma < 0.5 * COMMON_RAD)
    assert run.height_sigma < 0.002
    normalised = np.mean((run.tilt - true) ** 2 / run.variance, axis=0)
    assert np.all((normalised > 0.4) & (normalised < 1.7)), normalised


@pytest.mark.parametrize("seed", range(4))
def test_a_short_run_does_not_believe_too_much(seed: int) -> None:
    """Errors of verticals are a third of the stated ones, but for some frames, and tilts slow."""
    rng = np.random.default_rng(seed)
    time = np.arange(80)[:, None]
    true = np.radians(0.3 * np.sin(time / (9.0, 13.0)) + 0.2 * np.cos(time / 30.0))
    sigma = np.radians(rng.uniform(0.05, 0.2, true.shape))
    verticals = true + sigma * np.where(time % 8 == 0, 1.0, 0.3) * rng.standard_normal(true.shape)
    outlines = true + np.radians(0.1) * rng.standard_normal(true.shape)
    stated = np.full(true.shape, np.radians(0.3) ** 2)
    run = found_tilt(FrameTilts(verticals, sigma**2), FrameTilts(outlines, stated), np.zeros(2))
    assert np.mean((run.tilt - true) ** 2 / run.variance) < 1.5
    assert np.std(run.tilt - true) < 0.8 * np.std(verticals - true)


def test_outlines_that_disagree_leave_the_lens_in_doubt() -> None:
    true, measured, variance = sequence(3)
    sigma = np.radians(0.2)
    outlines = true + sigma * np.random.default_rng(1).standard_normal(true.shape)
    outlines[:, 0] += np.radians(1.0)
    run = found_tilt(
        FrameTilts(measured, variance), FrameTilts(outlines, np.full(true.shape, sigma**2))
    )
    assert np.all(run.lean_sigma > 0.9 * COMMON_RAD)
    assert run.variance.min() > (0.9 * COMMON_RAD) ** 2
    # A pitch that is a degree off by a wrong height is that of one 4 % wrong, at the most.
    assert run.height_sigma == pytest.approx(0.039 / math.sqrt(12.0), rel=0.2)
