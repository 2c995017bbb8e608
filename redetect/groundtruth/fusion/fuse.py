"""Fusion of odometry with ground truths: Kalman filter forward, smoothing backward (RAWSEEDS D2.1).

Odometry is the control, poses from laser and markers are the measurements. What odometry is off by
systematically (a share of turns and ways, a bend) is estimated along, since it is what decides how
far a gap can be bridged; how much it errs at random is what makes the measurements likeliest. The
nodes are the odometry's times and the measurements' own, between which odometry goes on along
arcs; so no measurement is interpolated, which would count the same noise twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion.controls import pauses_of
from redetect.groundtruth.fusion.learning import (
    likeliest_noise,
    looser_over_seconds,
    noise_of,
    terms_that_pay,
)
from redetect.groundtruth.fusion.localisation import LocalisationErrors, as_localisation
from redetect.groundtruth.fusion.movement import movement_problem
from redetect.groundtruth.fusion.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses, last_of_each_time
from redetect.landmarks import wrap_angle

__all__ = ["FuseSettings", "Fusion", "OdometryErrors", "Rejected", "fuse"]


@dataclass(frozen=True)
class Rejected:
    """A measurement that the gate kept out.

    Attributes
    ----------
    stream : str
        Its stream.
    time_s : float
    squared_innovation : float
        Squared normalised innovation.
    """

    stream: str
    time_s: float
    squared_innovation: float


@dataclass(frozen=True)
class OdometryErrors:
    """Odometry's errors estimated from the measurements.

    Attributes
    ----------
    turn_scale, turn_bias_per_metre, distance_scale : float
        By what share turns are longer than odometry says, the turn it misses per metre (rad), by
        what share ways are longer.
    turn_scale_sigma, turn_bias_per_metre_sigma, distance_scale_sigma : float
        Their standard deviations.
    distance_sigma, lateral_sigma, turn_sigma, turn_per_metre_sigma : float
        Its random errors, as in `FuseSettings`.
    looser_in_gaps : float
        By what factor their variances were raised where nothing was measured for more than a
        second, since odometry erred more over seconds than from sample to sample; 1 if it did not.
    """

    turn_scale: float
    turn_bias_per_metre: float
    distance_scale: float
    turn_scale_sigma: float
    turn_bias_per_metre_sigma: float
    distance_scale_sigma: float
    distance_sigma: float
    lateral_sigma: float
    turn_sigma: float
    turn_per_metre_sigma: float
    looser_in_gaps: float


@dataclass(frozen=True, eq=False)
class Fusion:
    """The robot's path from all streams.

    Attributes
    ----------
    poses : PlanarPoses
        At the odometry's times from the first measurement to the last, with covariances; headings
        within +-pi.
    rejected : tuple of Rejected
        In order of time.
    restarts_s : tuple of float
        When the filter was restarted because no measurement fitted any more.
    used : dict of str to int
        Measurements that went in, by stream.
    odometry : OdometryErrors
        The estimated errors of odometry.
    localisation : LocalisationErrors or None
        Errors of odometry that is a localisation, along which the path was estimated then.
    repaired : dict of str to int
        Covariances that were not positive definite as written, by stream; they were raised by their
        file's rounding.
    repeated : dict of str to int
        Rows that were the row before once more, by stream; they counted once.
    pauses_s : tuple of (float, float)
        Between which times odometry was not written, within the poses' time. What may have been
        driven there besides, at the rates at which the robot usually goes, makes it less certain.
    """

    poses: PlanarPoses
    rejected: tuple[Rejected, ...]
    restarts_s: tuple[float, ...]
    used: dict[str, int]
    odometry: OdometryErrors
    localisation: LocalisationErrors | None
    repaired: dict[str, int]
    repeated: dict[str, int]
    pauses_s: tuple[tuple[float, float], ...]


def fuse(
    odometry: PlanarPoses,
    streams: Mapping[str, PlanarPoses],
    settings: FuseSettings | None = None,
) -> Fusion:
    """Fuse odometry with poses measured by other means.

    Parameters
    ----------
    odometry : PlanarPoses
        The robot's own poses, on the measurements' clock; only movements between them count.
    streams : mapping of str to PlanarPoses
        Measured poses with covariances, by name.
    settings : FuseSettings, optional

    Returns
    -------
    Fusion

    Raises
    ------
    GroundTruthError
        If there is no measurement within the odometry's time, or no sample of odometry between the
        first measurement and the last; if a stream has no covariances, or one of them cannot be
        repaired.
    """
    chosen = settings or FuseSettings()
    problem = movement_problem(odometry, streams, chosen)
    first, last = problem.times_s[0], problem.times_s[-1]
    inside = odometry.times_s[(odometry.times_s >= first) & (odometry.times_s <= last)]
    if not len(inside):
        raise GroundTruthError(
            f"no sample of odometry from the first measured pose ({first:.3f} s) to the last "
            f"({last:.3f} s): expected some, which are the times of the result"
        )
    noise = likeliest_noise(problem) if chosen.learn_noise else noise_of(chosen)
    looser = looser_over_seconds(problem, noise) if chosen.learn_noise else 1.0
    smoothed, spread, account = problem.smooth(noise, looser)
    deviations = np.sqrt(np.maximum(np.diagonal(spread[-1])[3:], 0.0))
    over_seconds = math.sqrt(looser) * noise
    kept = terms_that_pay(problem, over_seconds, smoothed[-1, 3:], deviations)
    if not np.all(kept):
        problem = replace(problem, settings=chosen.with_terms(kept))
        smoothed, spread, account = problem.smooth(noise, looser)

    at = np.searchsorted(problem.times_s, inside)
    poses = smoothed[at, :3]
    poses[:, 2] = wrap_angle(poses[:, 2])
    path = PlanarPoses(inside, poses, spread[at][:, :3, :3].copy())
    squared, accepted, restarted = account.squared, account.accepted, account.restarted > 0
    localisation = None
    if chosen.learn_noise:
        found = as_localisation(last_of_each_time(odometry), problem, over_seconds, inside)
        if found is not None:
            path, squared, localisation = found
            accepted, restarted = squared <= problem.gate(), np.zeros_like(restarted)
    # Odometry's errors are constants: their final estimate uses all measurements.
    last_spread = np.sqrt(np.maximum(np.diagonal(spread[-1]), 0.0))
    return Fusion(
        poses=path,
        rejected=tuple(
            Rejected(
                problem.streams[i],
                float(problem.times_s[problem.nodes[i]]),
                float(squared[i]),
            )
            for i in np.flatnonzero(~accepted)
        ),
        restarts_s=tuple(float(time) for time in problem.times_s[restarted]),
        used={
            name: int(np.count_nonzero(accepted & (np.array(problem.streams) == name)))
            for name in streams
        },
        odometry=OdometryErrors(
            *np.concatenate([smoothed[-1, 3:], last_spread[3:], noise, [looser]]).tolist()
        ),
        localisation=localisation,
        repaired=problem.repaired,
        repeated=problem.repeated,
        pauses_s=tuple(
            (begin, end)
            for begin, end in pauses_of(last_of_each_time(odometry))
            if end > first and begin < last
        ),
    )
