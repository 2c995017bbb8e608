"""Localisation in a known map: an extended Kalman filter of the pose alone.

The map has errors of its own. They are the same each time a landmark is seen, so if its covariance
were added to that of each measurement, the filter would wrongly average them out. The filter
*considers* them instead: it propagates the correlation of the pose with each landmark's error
without estimating the landmarks again (Schmidt-Kalman filter).

A filter that considers the map's errors is slow to converge to the map after a stretch of wrong
odometry. That does little harm if rows have identifiers, but loses track if landmarks have to be
found. Then the gains are those of an exact map, and the covariance is that of a filter with such
gains: with S the derivatives of the pose's error by the errors of the landmarks, F and H those of a
step and of the measurements, K the gain, and C the covariance of the map, S C S^T is added, where

    S <- F S    at a step, and    S <- (I - K H_pose) S - K H_map    at a measurement

(covariance analysis: P. S. Maybeck, Stochastic Models, Estimation and Control 1, 1979, chapter 6).

Landmarks of a map made by driving share most of their error with their neighbours. The joint
covariance describes this (`LandmarkMap.joint_covariance`); without it landmarks are
assumed to be independent of each other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from redetect.array_types import FloatArray
from redetect.landmarks.map_file import LandmarkMap
from redetect.slam.association.registration import localise_globally
from redetect.slam.errors import SlamError
from redetect.slam.filters.base import POSE_SIZE, Filter, FrameRows
from redetect.slam.filters.run import BY_IDENTIFIERS, Associator, FilterRun, run_filter
from redetect.slam.models import move_jacobians
from redetect.slam.options import Localize
from redetect.slam.recording import NO_CAMERA, Recording, camera_xy_of

# Least effect of a landmark's error on the pose, m or rad per metre.
_NEGLIGIBLE = 1e-6


class Localizer(Filter):
    """The filter.

    Parameters
    ----------
    landmark_map : LandmarkMap
        The landmarks.
    start, start_covariance, camera_xy, common_tilt_variance : array_like
        As in `Filter`; the pose is in the map.
    exact : bool
        Use the gains of a map without errors; the covariance of the pose includes these.
    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        start: ArrayLike = (0.0, 0.0, 0.0),
        start_covariance: ArrayLike | None = None,
        camera_xy: ArrayLike = NO_CAMERA,
        *,
        common_tilt_variance: float = 0.0,
        exact: bool = False,
    ) -> None:
        super().__init__(start, start_covariance, camera_xy, common_tilt_variance)
        discs, lines = landmark_map.discs, landmark_map.lines
        first = self.size
        self.disc_slots = {int(i): first + 2 * k for k, i in enumerate(discs.ids)}
        of_lines = first + 2 * len(discs)
        self.line_slots = {int(i): of_lines + 2 * k for k, i in enumerate(lines.ids)}
        places = np.concatenate([discs.xy, lines.xy]).ravel()
        self._grow(len(places))
        self.size = len(self._state)
        self._state[first:] = self._linearised[first:] = places
        joint = landmark_map.joint_covariance
        if joint is None:
            joint = block_diag(*discs.covariance, *lines.covariance)[: len(places), : len(places)]
        #: Derivatives of the pose's error by the errors of the map, if the gains ignore these.
        self._by_map: FloatArray | None = None
        self._map_covariance, self._first = joint, first
        if exact:  # such a map has a known orientation: Jacobians are those at the latest pose
            self._linearised = self._state
            if np.any(joint):
                self._by_map = np.zeros((POSE_SIZE, len(places)))
        elif len(places):
            self._covariance[first:, first:] = joint

    @property
    def pose_covariance(self) -> FloatArray:
        """(3, 3), including the effect of the map's errors."""
        own = super().pose_covariance
        if self._by_map is None:
            return own
        # Landmarks that were not seen for long have no effect any more.
        seen = np.flatnonzero(np.any(np.abs(self._by_map) > _NEGLIGIBLE, axis=0))
        by_seen = self._by_map[:, seen]
        return own + by_seen @ self._map_covariance[np.ix_(seen, seen)] @ by_seen.T

    def predict(self, step: FloatArray, noise: FloatArray) -> FloatArray:
        """As of `Filter`."""
        if self._by_map is not None:
            by_pose, _ = move_jacobians(self._state[:POSE_SIZE], step)
            self._by_map = by_pose @ self._by_map
        return super().predict(step, noise)

    def measure(self, rows: FrameRows) -> None:
        """Update with the rows of a frame whose landmarks are in the map; others are ignored."""
        known, others = self._known(rows)
        self.count.leave_out("disc not in the map", len(others.circles))
        self.count.leave_out("line not in the map", len(others.lines))
        if not len(known.circles) and not len(known.lines):
            return
        innovation = self.innovation_of(known)
        factor, last = self._whitened(innovation)
        self.count.use(known, last)
        # The pose alone is corrected.
        self._state[:POSE_SIZE] += factor[:POSE_SIZE] @ last
        corrected = self._covariance[:POSE_SIZE] - factor[:POSE_SIZE] @ factor.T
        self._covariance[:POSE_SIZE], self._covariance[:, :POSE_SIZE] = corrected, corrected.T
        if self._by_map is not None:
            _, jacobian, index, noise = innovation
            gain = np.linalg.solve(noise, jacobian @ self._covariance[index, :POSE_SIZE]).T
            self._by_map -= gain @ jacobian[:, :POSE_SIZE] @ self._by_map
            of_map = index >= self._first
            by_rows = gain @ jacobian[:, of_map]
            np.subtract.at(self._by_map.T, index[of_map] - self._first, by_rows.T)


def localize_run(
    recording: Recording,
    landmark_map: LandmarkMap,
    pairing: Associator = BY_IDENTIFIERS,
    *,
    start: ArrayLike | None = (0.0, 0.0, 0.0),
    start_sigma: ArrayLike = (0.0, 0.0, 0.0),
    camera_xy: ArrayLike = NO_CAMERA,
    names: tuple[str, str] = ("run", "map"),
) -> FilterRun:
    """Localise a run in a map, with rows paired by their identifiers unless said otherwise.

    Takes the pose at the `start` in the map (m, m, rad) with its standard deviations, both (3,),
    the camera's centre (2,) in the robot frame (m), and names of run and map for messages. An
    unknown start, None, is estimated from the discs of the first frames, whatever their
    identifiers. Raises `SlamError` if that has no certain place, or no row shows a landmark.
    """
    covariance, found = np.diag(np.square(start_sigma)), None
    if start is None:
        found = localise_globally(recording, landmark_map.discs.xy)
        if found is None:
            raise SlamError(
                f"{names[0]}: the discs of the first frames have no certain place in {names[1]}: "
                "expected five or more that fit no other place as well; or give the pose by --start"
            )
        start, covariance = found.pose, found.covariance
    localizer = Localizer(
        landmark_map,
        start,
        covariance,
        camera_xy,
        common_tilt_variance=recording.common_tilt_variance,
        exact=pairing.method != "known",
    )
    run = run_filter(recording, localizer, pairing)
    if not run.count.discs and not run.count.lines:
        expected = "identifiers of the same run, or --association joint"
        if pairing.method != "known":
            expected = "some near one, seen from the pose at --start"
        raise SlamError(f"{names[0]}: no row shows a landmark of {names[1]}: expected {expected}")
    return replace(run, located=found)


def localize_by_flags(
    flags: Localize, recording: Recording, landmark_map: LandmarkMap
) -> FilterRun:
    """`localize_run` as the flags of `slam localize` state."""
    return localize_run(
        recording,
        landmark_map,
        Associator(flags.association, flags.gate_probability),
        start=flags.known_start,
        start_sigma=flags.start_sigma,
        camera_xy=camera_xy_of(recording, flags.run, flags.camera),
        names=(str(flags.run), str(flags.map)),
    )
