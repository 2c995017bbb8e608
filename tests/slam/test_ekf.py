"""EKF-SLAM against a plain dense filter, batch least squares, and Monte Carlo."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle
from redetect.plane import apply
from redetect.slam.errors import SlamError
from redetect.slam.filters.base import Prediction
from redetect.slam.filters.ekf_slam import EkfSlam, run_ekf
from redetect.slam.filters.run import Associator
from redetect.slam.models import disc_in_robot, disc_jacobians, move, move_jacobians
from redetect.slam.recording import LineRows, Recording
from tests.slam.ekf_rows import circle_rows, localizer, rows_of, spd


def drive(
    rng: np.random.Generator, *, steps: int, discs: int, noise: float = 1.0, sees: int = 5
) -> tuple[Recording, FloatArray, FloatArray]:
    """A run on a circle among discs, the true poses and the discs' true places."""
    places = rng.uniform(-4, 4, (discs, 2))
    pose, poses = np.zeros(3), [np.zeros(3)]
    measured, covariances, rows = [], [], []
    for k in range(steps):
        step = np.array([0.0, -0.3, 2 * np.pi / 60])
        covariance = spd(rng, 3, 0.01)
        pose = move(pose, step)
        measured.append(rng.multivariate_normal(step, noise**2 * covariance))
        covariances.append(covariance)
        poses.append(pose)
        for i in rng.choice(discs, sees, replace=False):
            spread = spd(rng, 2, 0.03)
            seen = rng.multivariate_normal(disc_in_robot(pose, places[i]), noise**2 * spread)
            rows.append((k, seen, spread, i + 1))
    recording = Recording(
        prefixes=tuple(f"a.{k:04d}" for k in range(steps)),
        steps=np.array(measured),
        step_covariance=np.array(covariances),
        circles=circle_rows(rows),
        lines=LineRows.of(),
    )
    return recording, np.array(poses), places


def dense_filter(recording: Recording) -> tuple[FloatArray, FloatArray, list[int]]:
    """EKF-SLAM written down plainly: full matrices, Joseph's form, the models of the report.

    What the heading turns is evaluated at `first`: poses as predicted, landmarks as first seen.
    """
    state, covariance, known = np.zeros(3), np.zeros((3, 3)), list[int]()
    first = np.zeros(3)
    circles = recording.circles
    for k in range(len(recording)):
        by_pose, by_step = move_jacobians(state[:3], recording.steps[k])
        state[:3] = move(state[:3], recording.steps[k])
        F = np.eye(len(state))
        F[:3, :3] = by_pose
        F[0, 2], F[1, 2] = first[1] - state[1], state[0] - first[0]
        first[:3] = state[:3]
        covariance = F @ covariance @ F.T
        covariance[:3, :3] += by_step @ recording.step_covariance[k] @ by_step.T
        here = np.flatnonzero(circles.frame == k)
        old = [i for i in here if int(circles.ids[i]) in known]
        if old:
            H = np.zeros((2 * len(old), len(state)))
            R = np.zeros((2 * len(old), 2 * len(old)))
            v = np.zeros(2 * len(old))
            for j, i in enumerate(old):
                at = 3 + 2 * known.index(int(circles.ids[i]))
                rows = slice(2 * j, 2 * j + 2)
                disc = state[at : at + 2]
                H[rows, :3], H[rows, at : at + 2] = disc_jacobians(state[:3], disc)
                H[rows, 2] = disc_jacobians(np.append(first[:2], state[2]), first[at : at + 2])[0][
                    :, 2
                ]
                v[rows] = circles.xy[i] - disc_in_robot(state[:3], disc)
                R[rows, rows] = circles.covariance[i]
            K = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + R)
            state = state + K @ v
            keep = np.eye(len(state)) - K @ H
            covariance = keep @ covariance @ keep.T + K @ R @ K.T
        for i in here:
            if i in old:
                continue
            measured_by = disc_jacobians(state[:3], apply(state[:3], circles.xy[i]))
            by_seen = np.linalg.inv(measured_by[1])
            by_pose = -by_seen @ measured_by[0]
            place = apply(state[:3], circles.xy[i])
            by_pose[:, 2] = first[1] - place[1], place[0] - first[0]
            G = np.zeros((2, len(state)))
            G[:, :3] = by_pose
            own = G @ covariance @ G.T + by_seen @ circles.covariance[i] @ by_seen.T
            covariance = np.block([[covariance, covariance @ G.T], [G @ covariance, own]])
            state, first = np.append(state, place), np.append(first, place)
            known.append(int(circles.ids[i]))
    return state, covariance, known


@pytest.mark.parametrize("seed", [1, 2])
def test_the_filter_is_the_plain_dense_one(seed: int) -> None:
    # So long that its covariance is written anew several times, and so large that it grows.
    recording, _, _ = drive(np.random.default_rng(seed), steps=150, discs=60)
    ekf = EkfSlam()
    run_ekf(recording, ekf)
    state, covariance, known = dense_filter(recording)
    assert list(ekf.disc_slots) == known
    np.testing.assert_allclose(ekf.state, state, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ekf.block(np.arange(ekf.size)), covariance, rtol=0, atol=1e-12)
    landmarks = ekf.landmark_map().discs
    np.testing.assert_array_equal(landmarks.ids, known)
    np.testing.assert_allclose(landmarks.covariance[7], covariance[17:19, 17:19], atol=1e-12)
    assert landmarks.rows.sum() == len(recording.circles)


def batch_solution(recording: Recording, size: int) -> tuple[FloatArray, FloatArray]:
    """Last pose and discs by Gauss-Newton on all poses and discs, and their covariance."""
    steps, circles = len(recording), recording.circles
    from redetect.plane import between, chain_steps
    from redetect.slam.models import between_jacobians

    poses = chain_steps(recording.steps)
    discs = np.zeros((size, 2))
    for i in reversed(range(len(circles))):
        discs[circles.ids[i] - 1] = apply(poses[circles.frame[i] + 1], circles.xy[i])
    unknowns = 3 * steps + 2 * size
    for _ in range(20):
        normal, right = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        for k in range(steps):
            error = recording.steps[k] - between(poses[k], poses[k + 1])
            error[2] = wrap_angle(error[2])
            J = np.zeros((3, unknowns))
            first, second = between_jacobians(poses[k], poses[k + 1])
            if k:
                J[:, 3 * k - 3 : 3 * k] = first
            J[:, 3 * k : 3 * k + 3] = second
            weight = np.linalg.inv(recording.step_covariance[k])
            normal += J.T @ weight @ J
            right += J.T @ weight @ error
        for i in range(len(circles)):
            k, d = circles.frame[i], circles.ids[i] - 1
            J = np.zeros((2, unknowns))
            at = 3 * steps + 2 * d
            J[:, 3 * k : 3 * k + 3], J[:, at : at + 2] = disc_jacobians(poses[k + 1], discs[d])
            weight = np.linalg.inv(circles.covariance[i])
            normal += J.T @ weight @ J
            right += J.T @ weight @ (circles.xy[i] - disc_in_robot(poses[k + 1], discs[d]))
        change = np.linalg.solve(normal, right)
        poses[1:] += change[: 3 * steps].reshape(-1, 3)
        discs += change[3 * steps :].reshape(-1, 2)
    wanted = np.arange(3 * steps - 3, unknowns)
    covariance = np.linalg.inv(normal)[np.ix_(wanted, wanted)]
    return np.concatenate([poses[-1], discs.ravel()]), np.asarray(covariance)


def test_the_filter_is_batch_least_squares_where_all_is_nearly_linear() -> None:
    rng = np.random.default_rng(3)
    # Errors of a hundredth of what the covariances say: linearised at the truth, nearly.
    recording, _, _ = drive(rng, steps=25, discs=8, noise=0.01)
    ekf = EkfSlam()
    run_ekf(recording, ekf)
    assert set(ekf.disc_slots) == set(range(1, 9))
    order = np.concatenate(
        [[0, 1, 2], *(np.array([0, 1]) + ekf.disc_slots[i] for i in range(1, 9))]
    ).astype(np.int64)
    state, covariance = batch_solution(recording, 8)
    sigma = np.sqrt(np.diag(covariance))
    # Both agree far better than they are apart from the odometry they started from.
    np.testing.assert_allclose((ekf.state[order] - state) / sigma, 0.0, atol=2e-3)
    ratio = ekf.block(np.arange(ekf.size))[np.ix_(order, order)] / np.outer(sigma, sigma)
    np.testing.assert_allclose(ratio, covariance / np.outer(sigma, sigma), atol=5e-3)


def test_covariance_of_a_new_disc_by_monte_carlo() -> None:
    rng = np.random.default_rng(4)
    pose, spread = np.array([1.0, -2.0, 0.7]), spd(rng, 3, 0.01)
    seen, noise = np.array([0.4, -1.8]), spd(rng, 2, 0.02)
    ekf = EkfSlam(pose, spread)
    ekf.measure(rows_of([(5, seen, noise)]))
    poses = rng.multivariate_normal(pose, spread, 200_000)
    sampled = apply(poses, rng.multivariate_normal(seen, noise, len(poses)))
    joint = np.cov(np.column_stack([poses, sampled]).T)
    found = ekf.block(np.arange(ekf.size))
    sigma = np.sqrt(np.diag(found))
    np.testing.assert_allclose(
        joint / np.outer(sigma, sigma), found / np.outer(sigma, sigma), atol=0.01
    )


def test_two_rows_of_one_new_disc_are_both_used() -> None:
    noise = 4e-4 * np.eye(2)
    ekf = EkfSlam()
    ekf.measure(rows_of([(1, np.array([0.0, -2.0]), noise), (1, np.array([0.02, -2.0]), noise)]))
    np.testing.assert_allclose(ekf.state[3:], [0.01, -2.0], atol=1e-12)
    np.testing.assert_allclose(ekf.block(np.array([3, 4])), noise / 2, atol=1e-15)
    assert ekf.count.discs == 2


def test_first_estimates_do_not_teach_the_heading() -> None:
    """Turning on the spot and looking at discs of its own tells nothing about the heading at first.

    The covariance of the heading never falls below what it was when the map began, which the
    textbook's filter violates (0.09).
    """
    rng = np.random.default_rng(11)
    ekf = EkfSlam(start_covariance=np.diag([0.1, 0.1, 0.1]))
    places, true = rng.uniform(-2, 2, (12, 2)), np.zeros(3)
    for k in range(60):
        if k:
            step, noise = np.array([0.0, -0.2, 0.3]), np.diag([4e-4, 4e-4, 4e-3])
            true = move(true, step)
            ekf.predict(rng.multivariate_normal(step, noise), noise)
        spread = 2e-2 * np.eye(2)
        seen = rng.multivariate_normal(np.zeros(2), spread, 12) + disc_in_robot(true, places)
        ekf.measure(rows_of([(i, xy, spread) for i, xy in enumerate(seen)]))
        assert ekf.pose_covariance[2, 2] >= 0.1 - 1e-9


def test_the_start_may_be_anywhere() -> None:
    recording, _, _ = drive(np.random.default_rng(9), steps=20, discs=10)
    here, there = EkfSlam(), EkfSlam(np.array([3.0, 1.0, 2.0]))
    run_ekf(recording, here)
    run_ekf(recording, there)
    moved = apply(np.array([3.0, 1.0, 2.0]), here.landmark_map().discs.xy)
    np.testing.assert_allclose(there.landmark_map().discs.xy, moved, atol=1e-9)


def test_a_step_that_fails_is_named() -> None:
    recording, _, _ = drive(np.random.default_rng(2), steps=5, discs=5)
    recording.circles.covariance[recording.circles.frame == 3] = -1e3 * np.eye(2)
    with pytest.raises(SlamError, match=r"step 4 \(a\.0003\): the covariance of the innovation"):
        run_ekf(recording, EkfSlam())


@pytest.mark.parametrize("method", ["nearest", "joint"])
def test_discs_are_found_again_without_identifiers(method: str) -> None:
    recording, _, places = drive(np.random.default_rng(12), steps=150, discs=12, noise=0.5, sees=4)
    near = np.linalg.norm(places[:, None] - places, axis=2) + 9 * np.eye(12)
    assert near.min() > 0.1
    ekf = EkfSlam()
    run = run_ekf(recording, ekf, Associator("joint" if method == "joint" else "nearest"))
    # One new identifier for each true one, and nearly all rows under it.
    pairs = np.stack([recording.circles.ids, run.disc_ids], axis=1)[run.disc_ids >= 0]
    kinds, rows = np.unique(pairs, axis=0, return_counts=True)
    assert rows[np.argsort(rows)][-12:].sum() > 0.95 * len(recording.circles)
    assert len(np.unique(kinds[np.argsort(rows)][-12:, 0])) == 12


def check_jacobian(of: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    return np.stack([(of(at + e) - of(at - e)) / 2e-6 for e in 1e-6 * np.eye(len(at))], axis=-1)


def test_frame_jacobian_is_the_derivative_of_the_prediction() -> None:
    state = np.append([0.3, -0.2, 0.4], np.random.default_rng(13).uniform(-3, 3, 6))

    def prediction(at: FloatArray) -> Prediction:
        return localizer(at[:3], at[3:7], at[7:]).predicted([3, 5], [7])

    jacobian = prediction(state).jacobian
    found = check_jacobian(lambda x: prediction(x).seen, state)
    np.testing.assert_allclose(jacobian, found, atol=1e-7)
