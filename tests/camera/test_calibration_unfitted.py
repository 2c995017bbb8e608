"""Terms of the lens that a calibration leaves out are in its covariance."""

from __future__ import annotations

import numpy as np

from camera import Camera
from camera.boards.board import Board
from camera.calibration.adjustment import Adjusted, Estimate, Points, fit_points
from camera.calibration.model import COUNT, CalibrationSettings, FreeLens
from camera.calibration.unfitted import with_unfitted_terms
from camera.rotations import rotation_of
from camera.uncertainty import (
    UNPOSED,
    intrinsics_of,
    pixel_grid,
    projection_sigma,
    with_intrinsics,
)
from tools.evaluation.boards import projection_difference

BOARD = Board("checkerboard", 9, 6, 0.03)
SETTINGS = CalibrationSettings(aspect=None)
TRIALS = 12


def seen_in_the_middle(camera: Camera, seed: int) -> tuple[Estimate, Points]:
    """Tilted boards that reach half way to the corners, with noise of 0.05 px."""
    rng = np.random.default_rng(seed)
    facing = np.diag([1.0, -1.0, -1.0])
    poses = [
        (
            rotation_of(rng.normal(size=3) * [0.4, 0.4, 0.3]) @ facing,
            np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.6, 0.7)]),
        )
        for _ in range(12)
    ]
    exact = np.concatenate([camera.project(BOARD.points @ R.T + t) for R, t in poses])
    count = len(BOARD.points)
    points = Points(
        np.tile(BOARD.points, (len(poses), 1)),
        exact + rng.normal(scale=0.05, size=exact.shape),
        np.repeat(np.arange(len(poses)), count),
        camera.width,
        camera.height,
    )
    return Estimate(intrinsics_of(camera), *map(np.stack, zip(*poses))), points


def fits(camera: Camera, lens: FreeLens) -> list[tuple[Adjusted, Points]]:
    made = []
    for seed in range(TRIALS):
        start, points = seen_in_the_middle(camera, seed)
        made.append((fit_points(start, points, SETTINGS, lens, 0.0)[0], points))
    return made


def normalised_errors(truth: Camera, fit: Adjusted) -> np.ndarray:
    """Squared errors of the projection over the image, each over its stated variance."""
    size = {"width": truth.width, "height": truth.height}
    found = with_intrinsics(UNPOSED, fit.estimate.intrinsics, **size)
    sigma = projection_sigma(found, fit.covariance)
    return np.asarray((projection_difference(truth, found) / sigma) ** 2)


def test_what_pictures_of_the_middle_do_not_show_is_uncertain_in_the_corners() -> None:
    """The fit without the lens's second coefficient is as good, and wrong where it extrapolates."""
    coef, tangential = (0.0, 0.03, 0.0, 0.3, 0.0), (3e-4, -3e-4)
    truth = Camera(640, 480, 400.0, 400.0, 322.0, 238.0, coef, UNPOSED.robot_from_camera,
                   tangential=tangential)  # fmt: skip
    lens = FreeLens(1)
    stated, without = [], []
    for fit, points in fits(truth, lens):
        assert fit.rms_px < 0.09
        whole = with_unfitted_terms(fit, points, lens, SETTINGS)
        np.testing.assert_array_equal(whole.estimate.intrinsics, fit.estimate.intrinsics)
        stated.append(np.mean(normalised_errors(truth, whole)))
        without.append(np.mean(normalised_errors(truth, fit)))
    assert np.mean(without) > 4.0
    assert 0.4 < np.mean(stated) < 1.4


def test_where_the_lens_is_shown_the_terms_add_little() -> None:
    truth = Camera(640, 480, 400.0, 400.0, 322.0, 238.0, (0.0, -0.2, 0.0, 0.3, 0.0),
                   UNPOSED.robot_from_camera)  # fmt: skip
    lens = FreeLens(2)
    u, v = pixel_grid(640, 480).T
    middle = (np.hypot(u - 320.0, v - 240.0) < 120.0).reshape(37, 49)
    for fit, points in fits(truth, lens)[:3]:
        whole = with_unfitted_terms(fit, points, lens, SETTINGS)
        found = with_intrinsics(UNPOSED, fit.estimate.intrinsics, width=640, height=480)
        sigmas = [projection_sigma(found, C) for C in (fit.covariance, whole.covariance)]
        ratio = sigmas[1] / sigmas[0]
        assert np.median(ratio[middle]) < 1.4
        assert np.all(ratio > 0.999)


def test_terms_that_the_settings_exclude_are_exactly_0() -> None:
    truth = with_intrinsics(
        UNPOSED, np.array([400.0, 400.0, 320.0, 240.0, *np.zeros(10)]), width=640, height=480
    )
    start, points = seen_in_the_middle(truth, 1)
    lens = FreeLens(0)
    fit, _ = fit_points(start, points, SETTINGS, lens, 0.0)
    excluded = CalibrationSettings(aspect=None, coefficients=0, tangential=False)
    assert with_unfitted_terms(fit, points, lens, excluded) is fit
    whole = with_unfitted_terms(fit, points, lens, SETTINGS)
    assert np.flatnonzero(np.diag(whole.covariance)).tolist() == [0, 1, 2, 3, 9, 10, 11, 12, 13]
    assert whole.covariance.shape == (COUNT, COUNT)
