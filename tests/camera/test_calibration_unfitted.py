"""Terms of the lens that a calibration leaves out are in its covariance."""

from __future__ import annotations

import numpy as np
import pytest

from camera import Camera
from camera.boards.board import Board
from camera.calibration.adjustment import (
    Adjusted,
    Estimate,
    Points,
    fit_points,
    with_unfitted_terms,
)
from camera.calibration.model import COUNT, CalibrationSettings, FreeLens
from camera.rotations import rotation_of
from camera.uncertainty import (
    IDENTITY,
    UNPOSED,
    intrinsics_of,
    projection_sigma,
    with_intrinsics,
)
from tools.evaluation.boards import projection_difference

BOARD = Board("checkerboard", 9, 6, 0.03)
SETTINGS = CalibrationSettings(aspect=None)
TRIALS = 12


def seen_boards(camera: Camera, seed: int, spread_m: float = 0.05) -> tuple[Estimate, Points]:
    """Tilted boards with noise of 0.03 px; by default they reach less than half way to a corner."""
    rng = np.random.default_rng(seed)
    facing = np.diag([1.0, -1.0, -1.0])
    poses = [
        (
            rotation_of(rng.normal(size=3) * [0.4, 0.4, 0.3]) @ facing,
            np.array([*rng.uniform(-spread_m, spread_m, 2), rng.uniform(0.45, 0.55)]),
        )
        for _ in range(12)
    ]
    exact = np.concatenate([camera.project(BOARD.points @ R.T + t) for R, t in poses])
    count = len(BOARD.points)
    points = Points(
        np.tile(BOARD.points, (len(poses), 1)),
        exact + rng.normal(scale=0.03, size=exact.shape),
        np.repeat(np.arange(len(poses)), count),
        camera.width,
        camera.height,
    )
    return Estimate(intrinsics_of(camera), *map(np.stack, zip(*poses))), points


def fits(camera: Camera, lens: FreeLens) -> list[tuple[Adjusted, Points]]:
    made = []
    for seed in range(TRIALS):
        start, points = seen_boards(camera, seed)
        made.append((fit_points(start, points, SETTINGS, lens, 0.0)[0], points))
    return made


def normalised_errors(truth: Camera, fit: Adjusted) -> np.ndarray:
    """Squared errors of the projection over the image, each over its stated variance."""
    size = {"width": truth.width, "height": truth.height}
    found = with_intrinsics(UNPOSED, fit.estimate.intrinsics, **size)
    sigma = projection_sigma(found, fit.covariance)
    return np.asarray((projection_difference(truth, found) / sigma) ** 2)


@pytest.mark.parametrize(("a3", "least_without"), [(0.03, 3.0), (-0.1, 30.0)])
def test_what_pictures_of_the_middle_do_not_show_is_uncertain_in_the_corners(
    a3: float, least_without: float
) -> None:
    """The fit without the lens's second coefficient is as good, and wrong where it extrapolates."""
    truth = Camera(640, 480, 400.0, 400.0, 322.0, 238.0, (0.0, a3, 0.0, 0.3, 0.0), IDENTITY,
                   tangential=(3e-4, -3e-4))  # fmt: skip
    lens = FreeLens(1)
    stated, without = [], []
    for fit, points in fits(truth, lens):
        assert fit.sigma_px < 0.033
        whole = with_unfitted_terms(fit, points, lens, SETTINGS)
        np.testing.assert_array_equal(whole.estimate.intrinsics, fit.estimate.intrinsics)
        stated.append(np.mean(normalised_errors(truth, whole)))
        without.append(np.mean(normalised_errors(truth, fit)))
    assert np.mean(without) > least_without
    assert 0.25 < np.mean(stated) < 3.0


def test_where_boards_show_the_lens_the_terms_add_little() -> None:
    truth = Camera(640, 480, 400.0, 400.0, 322.0, 238.0, (0.0, -0.2, 0.0, 0.3, 0.0), IDENTITY)
    lens = FreeLens(2)
    start, points = seen_boards(truth, 1, spread_m=0.25)
    fit, _ = fit_points(start, points, SETTINGS, lens, 0.0)
    whole = with_unfitted_terms(fit, points, lens, SETTINGS)
    sigmas = [projection_sigma(truth, each.covariance) for each in (fit, whole)]
    ratio = sigmas[1] / sigmas[0]
    assert np.all(ratio > 0.999)
    assert np.median(ratio) < 1.4


def test_terms_that_the_settings_exclude_are_exactly_0() -> None:
    truth = with_intrinsics(
        UNPOSED, np.array([400.0, 400.0, 320.0, 240.0, *np.zeros(10)]), width=640, height=480
    )
    start, points = seen_boards(truth, 1)
    lens = FreeLens(0)
    fit, _ = fit_points(start, points, SETTINGS, lens, 0.0)
    excluded = CalibrationSettings(aspect=None, coefficients=0, tangential=False)
    assert with_unfitted_terms(fit, points, lens, excluded) is fit
    whole = with_unfitted_terms(fit, points, lens, SETTINGS)
    assert np.flatnonzero(np.diag(whole.covariance)).tolist() == [0, 1, 2, 3, 9, 10, 11, 12, 13]
    assert whole.covariance.shape == (COUNT, COUNT)
