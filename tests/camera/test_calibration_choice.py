"""Which coefficients are free: as few as explain the pictures, of the kind that the lens is of."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from camera.calibration import choice as calibration_choice
from camera.calibration.adjustment import Adjusted, Estimate, Points
from camera.calibration.choice import Candidate, Candidates, choose_lens
from camera.calibration.model import COUNT, INTRINSICS, CalibrationSettings, FreeLens

COUNTED = 756
START = Estimate(np.zeros(COUNT), np.zeros((0, 3, 3)), np.zeros((0, 3)))
POINTS = Points(
    np.zeros((COUNTED, 3)), np.zeros((COUNTED, 2)), np.zeros(COUNTED, dtype=np.int64), 640, 480
)

# Hold-out errors (px), by the number of rational coefficients and of the polynomial's, without
# and with p1 and p2, as they come of some 14 boards with noise of 0.1 px.
# k 0.262 -0.953 1.163, p -0.0054 0.0026: a common depth camera.
DEPTH_CAMERA = {
    (0, 0): (0.788, 0.768), (1, 0): (0.494, 0.467), (2, 0): (0.282, 0.226), (3, 0): (0.304, 0.255),
    (4, 0): (0.229, 0.172), (5, 0): (0.216, 0.136), (0, 2): (0.49, 0.460), (0, 3): (0.21, 0.136),
}  # fmt: skip
# k 0.1 -0.2 0.05, p 0.001 -0.0015: a telephone, in 13 pictures.
TELEPHONE = {
    (0, 0): (0.742, 0.741), (1, 0): (0.771, 0.770), (2, 0): (0.645, 0.645), (3, 0): (0.645, 0.645),
    (4, 0): (0.645, 0.645), (5, 0): (0.645, 0.645), (0, 2): (0.155, 0.149), (0, 3): (0.135, 0.121),
}  # fmt: skip
# No distortion at all.
STRAIGHT = {
    (0, 0): (0.1358, 0.1358), (1, 0): (0.1358, 0.1358), (2, 0): (0.1359, 0.1358),
    (3, 0): (0.1531, 0.1533), (4, 0): (0.1526, 0.1526), (5, 0): (0.1357, 0.1357),
    (0, 2): (0.1359, 0.1359), (0, 3): (0.1357, 0.1357),
}  # fmt: skip
# A rational lens that the polynomial follows all but as well.
RATIONAL = {
    (0, 0): (7.0, 7.0), (1, 0): (0.4, 0.4), (2, 0): (0.1357, 0.1357), (3, 0): (0.1356, 0.1356),
    (4, 0): (0.1356, 0.1356), (5, 0): (0.1356, 0.1356), (0, 2): (0.14, 0.14),
    (0, 3): (0.1355, 0.1355),
}  # fmt: skip


@pytest.mark.parametrize(
    ("errors", "tangential", "chosen"),
    [
        # Five rational coefficients explain the pictures as well, and are 52 px off beside them.
        (DEPTH_CAMERA, None, FreeLens(0, True, 3)),
        (DEPTH_CAMERA, True, FreeLens(0, True, 3)),
        (DEPTH_CAMERA, False, FreeLens(0, False, 3)),
        # What no rational function follows hides that the lens is decentred.
        (TELEPHONE, None, FreeLens(0, True, 3)),
        (TELEPHONE, False, FreeLens(0, False, 3)),
        (STRAIGHT, None, FreeLens(0, False, 0)),
        # Not for one coefficient less than it has itself.
        (RATIONAL, None, FreeLens(2, False, 0)),
    ],
)
def test_the_fewest_coefficients_that_explain_what_was_held_out(
    monkeypatch: pytest.MonkeyPatch,
    errors: dict[tuple[int, int], tuple[float, float]],
    tangential: bool | None,
    chosen: FreeLens,
) -> None:
    def tried(
        points: Points,
        settings: CalibrationSettings,
        radius_m: float,
        full: Estimate,
        start: Estimate,
        lenses: Iterable[FreeLens],
    ) -> Candidates:
        return {lens: fitted(lens) for lens in lenses}

    def fitted(lens: FreeLens) -> Candidate:
        # 20 standard deviations of each.
        intrinsics, covariance = np.zeros(COUNT), np.zeros((COUNT, COUNT))
        for place in (INTRINSICS.index("p1"), INTRINSICS.index("p2")):
            intrinsics[place], covariance[place, place] = 20.0 * lens.tangential, 1.0
        estimate = Estimate(intrinsics, START.rotations, START.translations)
        nothing = np.zeros((COUNTED, 2))
        fit = Adjusted(estimate, 0.098, nothing, nothing, covariance, np.zeros((0, 6, 6)))
        radial = errors[lens.coefficients, lens.polynomial]
        return Candidate(fit, POINTS, radial[lens.tangential])

    monkeypatch.setattr(calibration_choice, "_fitted", tried)
    found, candidates = choose_lens(START, POINTS, CalibrationSettings(tangential=tangential), 0.0)
    assert found == chosen
    assert found in candidates
