"""Localisation in a known map: an extended Kalman filter of the pose alone.

The map has errors of its own. They are the same each time a landmark is seen, so if its covariance
were added to that of each measurement, the filter would wrongly average them out. The filter
*considers* them instead: it propagates the correlation of the pose with each landmark's error
without estimating the landmarks again (Schmidt-Kalman filter).

Landmarks of a map made by driving share most of their error with their neighbours. The joint
covariance describes this (`LandmarkMap.joint_covariance`); without it landmarks are
assumed to be independent of each other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from redetect.landmarks.map_file import LandmarkMap
from redetect.slam.association.registration import localise_globally
from redetect.slam.errors import SlamError
from redetect.slam.filters.base import POSE_SIZE, Filter, FrameRows
from redetect.slam.filters.run import BY_IDENTIFIERS, Associator, FilterRun, run_filter
from redetect.slam.options import Localize
from redetect.slam.recording import NO_CAMERA, Recording, camera_xy_of


class Localizer(Filter):
    """The filter.

    Parameters
    ----------
    landmark_map : LandmarkMap
        The landmarks.
    start, start_covariance, camera_xy, common_tilt_variance : array_like
        As in `Filter`; the pose is in the map.
    exact : bool
        Assume that the map is exact, whatever its covariances.
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
        if exact:  # such a map has a known orientation: Jacobians are those at the latest pose
            self._linearised = self._state
        elif len(places):
            joint = landmark_map.joint_covariance
            if joint is None:
                joint = block_diag(*discs.covariance, *lines.covariance)
            self._covariance[first:, first:] = joint

    def measure(self, rows: FrameRows) -> None:
        """Update with the rows of a frame whose landmarks are in the map; others are ignored."""
        known, others = self._known(rows)
        self.count.leave_out("disc not in the map", len(others.circles))
        self.count.leave_out("line not in the map", len(others.lines))
        if not len(known.circles) and not len(known.lines):
            return
        factor, last = self._whitened(known)
        self.count.use(known, last)
        # The pose alone is corrected.
        self._state[:POSE_SIZE] += factor[:POSE_SIZE] @ last
        corrected = self._covariance[:POSE_SIZE] - factor[:POSE_SIZE] @ factor.T
        self._covariance[:POSE_SIZE], self._covariance[:, :POSE_SIZE] = corrected, corrected.T


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
        # Considering the map's errors makes the filter slow to converge to it, which does little
        # harm with known pairs, but loses track if pairs have to be found.
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
