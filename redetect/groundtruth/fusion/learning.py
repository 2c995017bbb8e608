"""How much odometry errs at random: from sample to sample, and over seconds."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import chdtri

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.fusion.inputs import FuseSettings
from redetect.groundtruth.fusion.kernels import POSE
from redetect.groundtruth.fusion.movement import MovementProblem

# The factors on odometry's deviations that are tried, and over how many nodes.
_NOISE_FACTORS = (0.01, 20.0)
_MOST_NODES_TO_LEARN_FROM = 30_000
_LONGEST_GAP_TO_LEARN_FROM_S = 20.0
_LEARNING_ROUNDS = 2
# As far apart are measurements that odometry is to lead from one to the next, in how many rounds a
# factor is found, and how seldom right variances may look too small.
_SPACING_S = 2.0
_LOOSENING_ROUNDS = 3
_DOUBT = 0.001
# Akaike's: an estimate fits its own measurements that much better by chance.
_COST_OF_TERM = 2.0
# Share of its deviation before anything was measured below which an estimate counts as measured.
_MEASURED = 0.5


def noise_of(settings: FuseSettings) -> FloatArray:
    """Odometry's random errors: along a metre, across it (m), of a radian, of a metre (rad)."""
    return np.array(
        [
            settings.distance_sigma,
            settings.lateral_sigma,
            settings.turn_sigma,
            settings.turn_per_metre_sigma,
        ]
    )


def likeliest_noise(problem: MovementProblem) -> FloatArray:
    """Odometry's random errors that make the measurements likeliest, near those given.

    Long gaps are left out: by their ends a filter that is linearised may be lost, and then no noise
    is likelier than another for what odometry did.
    """
    some = problem.shortened(_MOST_NODES_TO_LEARN_FROM).split(_LONGEST_GAP_TO_LEARN_FROM_S)
    given = noise_of(problem.settings)
    logarithms = np.zeros(3)
    bounds = tuple(math.log(factor) for factor in _NOISE_FACTORS)

    def scaled(values: FloatArray) -> FloatArray:
        return np.asarray(given * np.exp(values[[0, 1, 2, 2]]))

    for _ in range(_LEARNING_ROUNDS):
        for axis in (2, 0, 1):

            def surprise(value: float, axis: int = axis) -> float:
                tried = logarithms.copy()
                tried[axis] = value
                return sum(part.surprise(scaled(tried)) for part in some)

            found = minimize_scalar(
                surprise, bounds=bounds, method="bounded", options={"xatol": 0.05}
            )
            logarithms[axis] = float(found.x)
    return scaled(logarithms)


def looser_over_seconds(problem: MovementProblem, noise: FloatArray) -> float:
    """By what factor odometry's variances over seconds are greater than samples by themselves say.

    A localisation, or odometry that was filtered, errs smoothly: hardly from sample to sample, and
    yet over a gap. So most measurements are left out, and what odometry makes of the ways between
    those that are left is compared with them. 1 unless errors are beyond what chance explains.
    """
    short = problem.shortened(_MOST_NODES_TO_LEARN_FROM)
    # Outliers would look like odometry's errors, more so where few others are left.
    some = [
        part.thinned(_SPACING_S)
        for part in short.with_only(short.account(noise).accepted).split(
            _LONGEST_GAP_TO_LEARN_FROM_S
        )
    ]
    numbers = POSE * sum(len(part.nodes) - 1 for part in some)
    if numbers == 0:
        return 1.0
    looser = 1.0
    for _ in range(_LOOSENING_ROUNDS):
        # The first one of each part says nothing of odometry.
        squared = sum(
            float(np.sum(np.minimum(account.squared[1:], problem.gate())))
            for account in (part.account(math.sqrt(looser) * noise) for part in some)
        )
        if looser == 1.0 and squared < chdtri(numbers, _DOUBT):
            return 1.0
        looser *= max(squared / numbers, 1.0)
    return looser


def terms_that_pay(
    problem: MovementProblem, noise: FloatArray, means: FloatArray, deviations: FloatArray
) -> BoolArray:
    """(3,) which of odometry's systematic errors, as estimated, make better predictions over
    seconds.

    They are estimated from sample to sample. Where odometry's own jitter is a part of these
    samples, measured poses deny it, and a share of turns comes out that is none (regression
    dilution). Over seconds, and over gaps, such an estimate predicts worse than none.
    """
    thin = problem.thinned(_SPACING_S)
    kept = deviations > 0.0

    def surprise(terms: BoolArray) -> float:
        account = thin.account(noise, (means * terms, deviations * terms))
        return account.surprise + _COST_OF_TERM * np.count_nonzero(terms)

    best = surprise(kept)
    # What was hardly measured stays as uncertain as it is.
    measured = deviations < _MEASURED * problem.settings.systematic_sigmas()
    while np.any(kept & measured):
        fewer = [kept & (np.arange(3) != term) for term in np.flatnonzero(kept & measured)]
        tried = [surprise(terms) for terms in fewer]
        if min(tried) > best:
            break
        best, kept = min(tried), fewer[int(np.argmin(tried))]
    return kept
