"""Calibration from points: derivatives, known truth back, covariance, what cannot be calibrated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from camera import Camera
from camera.boards.board import Board
from camera.calibration.adjustment import (
    Adjusted,
    Estimate,
    Points,
    adjust,
    circle_shifts,
    fit_points,
    project_estimate,
)
from camera.calibration.calibrate import (
    BoardView,
    calibrate,
    coverage_warnings,
    points_of,
    warnings_of,
)
from camera.calibration.model import (
    COUNT,
    INTRINSICS,
    CalibrationSettings,
    FreeLens,
    has_pole,
    is_possible,
    pixels_of_points,
    project_points,
)
from camera.errors import CalibrationError
from camera.rotations import rotation_of
from camera.uncertainty import (
    intrinsics_of,
    projection_sigma,
    with_intrinsics,
)
from tools.evaluation.boards import board_poses, projection_difference

BOARD = Board("checkerboard", 9, 6, 0.04)
HALF = CalibrationSettings(aspect=0.5)
DISTANCES_M = (0.2, 0.45)
IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))


def seen_views(
    camera: Camera, views: int, sigma_px: float, seed: int, board: Board = BOARD
) -> list[BoardView]:
    """Boards as the camera sees them, with noise."""
    rng = np.random.default_rng(seed)
    every = np.arange(len(board.points))
    return [
        BoardView(
            f"{i:02d}.png",
            every,
            camera.project(board.points @ R.T + t)
            + rng.normal(scale=sigma_px, size=(len(every), 2)),
        )
        for i, (R, t) in enumerate(board_poses(camera, board, views, seed, distances_m=DISTANCES_M))
    ]


BROWN = pytest.mark.parametrize(
    ("tangential", "polynomial"),
    [
        ((0.0, 0.0), (0.0, 0.0, 0.0)),
        ((2e-3, -3e-3), (0.0, 0.0, 0.0)),
        ((2e-3, 0.0), (-0.1, 0.05, 0.02)),
    ],
)


@BROWN
def test_points_are_projected_as_the_camera_projects_them(
    published_camera: Camera,
    tangential: tuple[float, float],
    polynomial: tuple[float, float, float],
) -> None:
    camera = replace(published_camera, tangential=tangential, polynomial=polynomial)
    points = np.random.default_rng(1).normal(loc=[0.0, 0.0, 1.0], size=(200, 3))
    pixels, _, _ = project_points(intrinsics_of(camera), points)
    np.testing.assert_allclose(pixels, camera.project(points), rtol=0.0, atol=1e-10)
    np.testing.assert_array_equal(pixels_of_points(intrinsics_of(camera), points), pixels)
    assert with_intrinsics(published_camera, intrinsics_of(camera)) == camera


@BROWN
def test_derivatives_of_the_projection_are_those_of_differences(
    published_camera: Camera,
    tangential: tuple[float, float],
    polynomial: tuple[float, float, float],
) -> None:
    intrinsics = intrinsics_of(
        replace(published_camera, tangential=tangential, polynomial=polynomial)
    )
    points = np.array([[0.1, 0.2, 0.7], [-0.3, 0.05, 0.5], [0.0, 0.0, 1.0], [0.4, -0.3, 0.6]])
    _, by_intrinsics, by_point = project_points(intrinsics, points)
    for k in range(COUNT):
        step = np.zeros(COUNT)
        step[k] = 1e-5
        ahead = project_points(intrinsics + step, points)[0]
        behind = project_points(intrinsics - step, points)[0]
        np.testing.assert_allclose(by_intrinsics[:, :, k], (ahead - behind) / 2e-5, atol=2e-5)
    for k in range(3):
        move = np.zeros(3)
        move[k] = 1e-6
        ahead = project_points(intrinsics, points + move)[0]
        behind = project_points(intrinsics, points - move)[0]
        # On the axis a2 r has a cusp; its differences vanish with the step.
        np.testing.assert_allclose(by_point[:, :, k], (ahead - behind) / 2e-6, atol=1e-3)


def test_derivatives_by_the_pose_are_those_of_differences(published_camera: Camera) -> None:
    views = seen_views(published_camera, 1, 0.0, seed=3)
    points = points_of(views, BOARD, (768, 288))
    R, t = board_poses(published_camera, BOARD, 1, 3, distances_m=DISTANCES_M)[0]
    intrinsics = intrinsics_of(published_camera)
    by_pose = project_estimate(Estimate(intrinsics, R[None], t[None]), points)[2]
    for k in range(6):
        found = []
        for sign in (1.0, -1.0):
            step = np.zeros(6)
            step[k] = sign * 1e-6
            moved = Estimate(intrinsics, (rotation_of(step[:3]) @ R)[None], (t + step[3:])[None])
            found.append(project_estimate(moved, points)[0])
        difference = (found[0] - found[1]) / 2e-6
        np.testing.assert_allclose(by_pose[:, :, k], difference, rtol=1e-5, atol=1e-3)


@pytest.mark.long
def test_exact_points_give_the_published_camera_back(published_camera: Camera) -> None:
    views = seen_views(published_camera, 14, 0.0, seed=5)
    settings = CalibrationSettings(aspect=0.5, coefficients=5, robust=False)
    result = calibrate(views, BOARD, (768, 288), settings)
    found = with_intrinsics(published_camera, result.intrinsics)
    assert projection_difference(published_camera, found, rotate=False).max() < 1e-3
    assert result.adjusted.rms_px < 1e-4


@pytest.mark.long
def test_noisy_points_and_wrong_ones_give_the_projection_to_its_predicted_error(
    published_camera: Camera,
) -> None:
    views = seen_views(published_camera, 25, 0.05, seed=11)
    rng = np.random.default_rng(2)
    for view in views:
        wrong = rng.integers(len(view.indices))
        view.pixels[wrong] += rng.normal(scale=4.0, size=2)
    # One picture in which the board was found one square off.
    views[7].pixels[:-1] = views[7].pixels[1:].copy()
    result = calibrate(views, BOARD, (768, 288), replace(HALF, polynomial=False))
    assert [name for name, _ in result.outliers] == ["07.png"]
    assert any("points excluded" in warning for warning in result.warnings)
    assert result.adjusted.sigma_px == pytest.approx(0.05, rel=0.1)
    assert result.adjusted.rms_px == pytest.approx(0.05 * np.sqrt(2.0), rel=0.1)
    found = with_intrinsics(published_camera, result.intrinsics)
    away = projection_difference(published_camera, found)
    sigma = projection_sigma(found, result.adjusted.covariance)
    assert away.max() < 0.1 + 3.0 * sigma.max()
    assert np.mean(away < 3.0 * sigma) > 0.95
    # Fewer coefficients than the lens has are seen through by the pictures held out.
    assert not result.lens.tangential
    assert result.cross_validation_px[FreeLens(1)] > 2.0 * result.cross_validation_px[result.lens]


def test_a_decentred_lens_is_found_and_a_radial_one_stays_radial() -> None:
    """What was too little to tell from noise is not chosen; what is, comes back to its error."""
    coef = (0.0, -0.2, 0.0, 0.3, 0.0)
    radial = Camera(640, 480, 480.0, 480.0, 322.0, 238.0, coef, IDENTITY)
    settings = CalibrationSettings(coefficients=2)
    for tangential, found in (((0.0, 0.0), False), ((1e-3, -2e-3), True)):
        truth = replace(radial, tangential=tangential)
        views = seen_views(truth, 9, 0.1, seed=3)
        result = calibrate(views, BOARD, (640, 480), settings)
        assert result.lens == FreeLens(2, found)
        assert set(result.cross_validation_px) == {FreeLens(2, False), FreeLens(2, True)}
        camera = with_intrinsics(radial, result.intrinsics)
        assert projection_difference(truth, camera).max() < 0.3
        forced = replace(settings, tangential=not found)
        other = calibrate(views, BOARD, (640, 480), forced)
        assert other.lens == FreeLens(2, not found)
        decentred = result if found else other
        sigma = np.sqrt(np.diag(decentred.adjusted.covariance)[9:11])
        assert np.all(np.abs(decentred.intrinsics[9:11] - tangential) < 4.0 * sigma)
        assert np.all(sigma < 3e-4)
        assert (result if other.lens.tangential else other).intrinsics[9:].tolist() == [0.0] * 5


def test_a_polynomial_instead_of_the_rational_function_comes_back() -> None:
    euroc = Camera(
        752, 480, 458.0, 458.0, 367.0, 248.0, (0.0,) * 5, IDENTITY,
        polynomial=(-0.28340811, 0.07395907, 0.0),
    )  # fmt: skip
    views = seen_views(euroc, 9, 0.1, seed=3)
    settings = CalibrationSettings(polynomial=True, tangential=False)
    result = calibrate(views, BOARD, (752, 480), settings)
    assert set(result.cross_validation_px) == {FreeLens(0, False, count) for count in range(4)}
    # k3 is 0, and one coefficient is seen through.
    assert result.lens == FreeLens(0, False, 2)
    assert str(result.lens) == "k1 k2"
    assert (
        result.cross_validation_px[FreeLens(0, False, 1)]
        > 1.2 * result.cross_validation_px[result.lens]
    )
    assert result.intrinsics[4:11].tolist() == [0.0] * 7
    sigma = np.sqrt(np.diag(result.adjusted.covariance)[11:13])
    assert np.all(sigma > 0.0)
    assert np.all(np.abs(result.intrinsics[11:13] - euroc.polynomial[:2]) < 4.0 * sigma)
    found = with_intrinsics(euroc, result.intrinsics)
    assert projection_difference(euroc, found).max() < 0.5
    with pytest.raises(CalibrationError, match="coefficients"):
        CalibrationSettings(polynomial=True, coefficients=4)


@pytest.mark.long
def test_the_polynomial_is_chosen_where_the_rational_function_cannot_follow() -> None:
    """A lens of k1 k2 k3 as of a common depth camera."""
    wavy = Camera(
        640, 480, 517.0, 517.0, 318.6, 255.3, (0.0,) * 5, IDENTITY,
        polynomial=(0.2624, -0.9531, 1.1633),
    )  # fmt: skip
    views = seen_views(wavy, 6, 0.05, seed=7)
    result = calibrate(views, BOARD, (640, 480), CalibrationSettings(tangential=False))
    assert result.lens == FreeLens(0, False, 3)
    found = with_intrinsics(wavy, result.intrinsics)
    assert projection_difference(wavy, found).max() < 0.3


@pytest.mark.long
def test_predicted_covariance_is_what_repetition_shows(published_camera: Camera) -> None:
    """The same boards again and again with new noise."""
    camera = replace(published_camera, tangential=(2e-3, -3e-3))
    poses = board_poses(camera, BOARD, 15, 4, distances_m=DISTANCES_M)
    truth = Estimate(intrinsics_of(camera), *map(np.stack, zip(*poses)))
    exact = Points(
        np.tile(BOARD.points, (len(poses), 1)),
        np.concatenate([camera.project(BOARD.points @ R.T + t) for R, t in poses]),
        np.repeat(np.arange(len(poses)), len(BOARD.points)),
        camera.width,
        camera.height,
    )
    lens = FreeLens(5, tangential=True)
    free = np.linalg.pinv(lens.span(HALF.aspect))
    assert len(free) == 10
    rng = np.random.default_rng(5)
    errors, covariances, nees = [], [], []
    for _ in range(40):
        noise = rng.normal(scale=0.02, size=exact.pixels.shape)
        points = replace(exact, pixels=exact.pixels + noise)
        fit, _ = fit_points(truth, points, HALF, lens, 0.0)
        errors.append(fit.estimate.intrinsics - truth.intrinsics)
        covariances.append(fit.covariance)
        reduced = free @ fit.covariance @ free.T
        scale = np.sqrt(np.diag(reduced))
        whitened = (free @ errors[-1]) / scale
        nees.append(whitened @ np.linalg.solve(reduced / np.outer(scale, scale), whitened))
    predicted = np.sqrt(np.diag(np.mean(covariances, axis=0)))
    assert not np.any(np.array(errors)[:, 11:])
    # 40 trials know a standard deviation to 11 %.
    ratio = np.std(errors, axis=0)[:11] / predicted[:11]
    assert np.all((ratio > 0.67) & (ratio < 1.4)), ratio
    limit = 3.0 * np.sqrt(2.0 * len(free) / len(nees))
    assert np.mean(nees) == pytest.approx(len(free), abs=limit)


def test_pose_covariance_is_what_repetition_shows(published_camera: Camera) -> None:
    R, t = board_poses(published_camera, BOARD, 1, 8, distances_m=DISTANCES_M)[0]
    truth = Estimate(intrinsics_of(published_camera), R[None], t[None])
    exact = published_camera.project(BOARD.points @ R.T + t)
    rng = np.random.default_rng(5)
    nees = []
    for _ in range(150):
        noisy = exact + rng.normal(scale=0.1, size=exact.shape)
        points = Points(BOARD.points, noisy, np.zeros(len(noisy), dtype=np.int64), 768, 288)
        fit = adjust(truth, points, np.zeros((COUNT, 0)), robust=False, sigma_px=0.1)
        turn = fit.estimate.rotations[0] @ R.T
        vector = 0.5 * np.array(
            [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        )
        error = np.concatenate([vector, fit.estimate.translations[0] - t])
        nees.append(error @ np.linalg.solve(fit.pose_covariances[0], error))
    assert np.mean(nees) == pytest.approx(6.0, abs=3.0 * np.sqrt(12.0 / 150))


def test_circles_shift_is_that_of_the_rendered_area(published_camera: Camera) -> None:
    board = Board("circles", 3, 3, 0.05, circle_m=0.03)
    R, t = board_poses(published_camera, board, 1, 2, distances_m=(0.2, 0.25))[0]
    truth = Estimate(intrinsics_of(published_camera), R[None], t[None])
    centres = published_camera.project(board.points @ R.T + t)
    points = Points(board.points, centres, np.zeros(len(centres), dtype=np.int64), 768, 288)
    shifts = circle_shifts(truth, points, 0.015)
    # By brute force: the middle of all fine pixels whose ray meets the first circle.
    u, v = np.round(centres[0])
    offsets = np.arange(-60.0, 60.0, 0.125)
    pixels = np.stack(np.meshgrid(u + offsets, v + offsets), axis=-1).reshape(-1, 2)
    rays = published_camera.unproject(pixels)
    place = (rays * (R[:, 2] @ t / (rays @ R[:, 2]))[:, None] - t) @ R
    inside = np.linalg.norm(place[:, :2] - board.points[0, :2], axis=1) < 0.015
    brute = pixels[inside].mean(axis=0) - centres[0]
    assert np.linalg.norm(brute) > 0.05
    np.testing.assert_allclose(shifts[0], brute, atol=0.01)


def test_a_fold_inside_the_image_is_not_possible() -> None:
    plain = np.array([460.0, 230.0, 384.0, 144.0, *[0.0] * 10])
    assert is_possible(plain, 768, 288)
    folded = plain.copy()
    folded[5] = -0.4
    assert not is_possible(folded, 768, 288)
    # Without radial terms the nearest fold, at r = 1 / (6 p), is seen at 1 / (12 p).
    for p, possible in ((0.05, True), (0.1, False)):
        decentred = plain.copy()
        decentred[9:11] = (0.6 * p, -0.8 * p)
        assert is_possible(decentred, 768, 288) == possible
    # A weak pole at r = 1: all of the image beyond would be there.
    pole = np.array([268.0, 268.0, 239.0, 319.0, 0.0, 0.001, 0.0, -1.0, *[0.0] * 6])
    assert is_possible(pole, 480, 640)
    assert has_pole(pole, 480, 640)
    pole[2:4] = 99.0
    assert not has_pole(pole, 200, 200)
    # A fold barely outside the image is none.
    folding = plain.copy()
    folding[5] = -0.133
    assert is_possible(folding, 768, 288)
    assert not has_pole(folding, 768, 288)
    fold = Camera(768, 288, 460.0, 230.0, 384.0, 144.0, (0.0, -0.4, 0.0, 0.0, 0.0), IDENTITY)
    assert fold.seen_share < 1.0


def test_a_lens_with_a_pole_is_not_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = Camera(640, 480, 480.0, 480.0, 322.0, 238.0, (0.0, -0.2, 0.0, 0.3, 0.0), IDENTITY)
    views = seen_views(truth, 5, 0.1, seed=3)
    settings = CalibrationSettings(tangential=False, polynomial=False)
    assert calibrate(views, BOARD, (640, 480), settings).lens == FreeLens(2)
    # As if these had one.
    b2 = INTRINSICS.index("b2")
    monkeypatch.setattr("camera.calibration.choice.has_pole", lambda lens, *_: lens[b2] != 0.0)
    found = calibrate(views, BOARD, (640, 480), settings)
    assert found.lens == FreeLens(1)
    assert found.cross_validation_px[FreeLens(2)] == np.inf


def test_free_span_ties_the_scales() -> None:
    span = FreeLens(2).span(0.5)
    assert span.shape == (14, 5)
    assert span[1, 0] == 0.5 * span[0, 0]
    assert FreeLens(5).span(None).shape == (14, 9)
    assert FreeLens(5, tangential=True).span(None).shape == (14, 11)
    assert FreeLens(0, tangential=True, polynomial=3).span(1.0).shape == (14, 8)


def test_too_few_pictures_say_how_many_are_needed(published_camera: Camera) -> None:
    views = seen_views(published_camera, 2, 0.05, seed=1)
    with pytest.raises(CalibrationError, match=r"2 pictures.*at least 3 are needed"):
        calibrate(views, BOARD, (768, 288), HALF)


def test_parallel_boards_are_refused() -> None:
    camera = Camera(
        640,
        480,
        900.0,
        900.0,
        320.0,
        240.0,
        (0.0, 0.0, 0.0, 0.0, 0.0),
        IDENTITY,
    )
    facing = np.diag([1.0, -1.0, -1.0])
    rng = np.random.default_rng(3)
    views = []
    for i in range(8):
        t = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.6, 1.0)])
        pixels = camera.project(BOARD.points @ facing.T + t)
        views.append(
            BoardView(f"{i}", np.arange(54), pixels + rng.normal(scale=0.05, size=pixels.shape))
        )
    with pytest.raises(CalibrationError, match=r"almost the same orientation.*tilt the board"):
        calibrate(views, BOARD, (640, 480), CalibrationSettings(coefficients=1))


def test_what_of_the_image_was_not_covered_is_told(published_camera: Camera) -> None:
    pixels = np.random.default_rng(0).uniform([10, 10], [500, 180], size=(500, 2))
    points = Points(np.zeros((500, 3)), pixels, np.zeros(500, dtype=np.int64), 768, 288)
    told = "\n".join(coverage_warnings(intrinsics_of(published_camera), points))
    assert "bottom left" in told
    assert "top right" in told
    assert "top left" not in told


def fit_to_one_view(camera: Camera) -> tuple[Adjusted, Points]:
    R, t = board_poses(camera, BOARD, 1, 8, distances_m=DISTANCES_M)[0]
    truth = Estimate(intrinsics_of(camera), R[None], t[None])
    points = points_of(seen_views(camera, 1, 0.1, seed=8), BOARD, (768, 288))
    fit = adjust(truth, points, np.zeros((COUNT, 0)))
    return fit, points


def test_residuals_that_no_board_leaves_are_told(published_camera: Camera) -> None:
    """A fisheye lens that sees more than the model can is fitted as well as it can be."""
    fit, points = fit_to_one_view(published_camera)
    for times, told in ((1.0, False), (20.0, True)):
        worse = replace(fit, residuals=times * fit.residuals)
        assert any("do not fit" in text for text in warnings_of(worse, points, 40.0)) == told


def test_an_uncertain_projection_is_told(published_camera: Camera) -> None:
    fit, points = fit_to_one_view(published_camera)
    for sigma, told in ((0.001, False), (0.1, True)):
        covariance = np.zeros((COUNT, COUNT))
        covariance[11, 11] = sigma**2
        worse = replace(fit, covariance=covariance)
        assert any("is uncertain by" in text for text in warnings_of(worse, points, 40.0)) == told


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("checkerboard", 2, 6, 0.04), "at least 3 x 3"),
        (("checkerboard", 10**12, 7, 0.04), "at most 1000 each way"),
        (("checkerboard", 9, 6, 0.0), "metres above 0"),
        (("checkerboard", 9, 6, 25.0), "square_m is 25: .*25 mm are 0.025"),
        (("charuco", 9, 6, 0.04), "marker_m is 0"),
        (("circles", 9, 6, 0.04, 0.0, "DICT_5X5_100", 0.1), "below the circles' distance"),
        (("circles", 9, 6, 0.04, 0.0, "DICT_5X5_100", 0.05), "below the circles' distance, 0.04"),
        (
            ("asymmetric-circles", 4, 11, 0.04, 0.0, "DICT_5X5_100", 0.06),
            "below the circles' distance, 0.0565685",
        ),
        (
            ("checkerboard", 9, 6, 0.04, 0.0, "DICT_5X5_100", 0.02),
            "a checkerboard board has no circles",
        ),
    ],
)
def test_impossible_boards(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        Board(*arguments)  # type: ignore[arg-type]


def test_boards_that_look_the_same_turned() -> None:
    assert Board("checkerboard", 8, 6, 0.1).is_symmetric
    assert not Board("checkerboard", 9, 6, 0.1).is_symmetric
    assert Board("circles", 9, 6, 0.1).is_symmetric
    assert not Board("asymmetric-circles", 4, 11, 0.1).is_symmetric
    for board in (Board("checkerboard", 9, 6, 0.1), Board("asymmetric-circles", 4, 11, 0.1)):
        # Turned by 180 degrees, the set of points (and of black squares) is or is not the same.
        turned = -board.points
        away = np.linalg.norm(board.points[:, None] - turned, axis=-1).min(axis=0)
        assert (away.max() < 1e-9) == (board.kind == "checkerboard")
