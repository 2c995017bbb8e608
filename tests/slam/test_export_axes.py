"""The turn into other tools' axes: means, covariances and the models agree with it, bit by bit."""

from __future__ import annotations

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.landmarks.axes import covariance_from_dataset, from_dataset, to_dataset
from redetect.slam.models import bearing_of_vertical, disc_in_robot, move


def some_covariances(rng: np.random.Generator, count: int, size: int) -> FloatArray:
    root = rng.normal(size=(count, size, size))
    return np.asarray(root @ np.swapaxes(root, 1, 2))


def test_forward_is_x_and_left_is_y() -> None:
    forward, left = [0.0, -1.0], [1.0, 0.0]  # the data set's: X left, Y backward
    np.testing.assert_array_equal(from_dataset(forward, "robotics"), [1.0, 0.0])
    np.testing.assert_array_equal(from_dataset(left, "robotics"), [0.0, 1.0])
    np.testing.assert_array_equal(from_dataset(forward, "dataset"), forward)


@pytest.mark.parametrize("size", [2, 3])
def test_covariances_are_rotated_as_vectors_are(size: int) -> None:
    rng = np.random.default_rng(2)
    covariance = some_covariances(rng, 20, size)
    quarter = np.eye(size)
    quarter[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    expected = quarter @ covariance @ quarter.T
    np.testing.assert_array_equal(covariance_from_dataset(covariance, "robotics"), expected)
    # The spread of rotated samples is the rotated spread.
    samples = rng.multivariate_normal(np.zeros(size), covariance[0], 50)
    np.testing.assert_allclose(
        np.cov(from_dataset(samples, "robotics").T),
        covariance_from_dataset(np.cov(samples.T), "robotics"),
        rtol=1e-12,
    )


def test_a_disc_known_well_to_the_side_is_so_afterwards() -> None:
    # Far less certain along Y (ahead) than along X (across): then along the new X.
    turned = covariance_from_dataset([[0.01, 0.002], [0.002, 0.5]], "robotics")
    np.testing.assert_array_equal(turned, [[0.5, -0.002], [-0.002, 0.01]])


def test_there_and_back_gives_the_same_bits() -> None:
    rng = np.random.default_rng(3)
    for size in (2, 3):
        values = rng.normal(size=(50, size))
        values[0] = 0.0
        values[1] = -0.0
        assert to_dataset(from_dataset(values)).tobytes() == values.tobytes()
        covariance = some_covariances(rng, 50, size)
        covariance[0] = np.diag(np.ones(size))
        back = covariance_from_dataset(covariance_from_dataset(covariance), back=True)
        assert np.asarray(back + 0.0).tobytes() == np.asarray(covariance + 0.0).tobytes()


def test_the_models_hold_in_both_axes() -> None:
    """Robot and map turn alike: moving and measuring commute with the change of axes."""
    rng = np.random.default_rng(4)
    poses, steps, discs = rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), rng.normal(size=(9, 2))
    turned = from_dataset(poses, "robotics")
    np.testing.assert_array_equal(turned[:, 2], poses[:, 2])
    np.testing.assert_allclose(
        move(turned, from_dataset(steps, "robotics")),
        from_dataset(move(poses, steps), "robotics"),
        atol=1e-14,
    )
    seen = disc_in_robot(turned, from_dataset(discs, "robotics"))
    expected = from_dataset(disc_in_robot(poses, discs), "robotics")
    np.testing.assert_allclose(seen, expected, atol=1e-14)
    # A bearing from forward to the left is atan2(y, x) there, and the same angle.
    bearing = bearing_of_vertical(poses, discs, np.zeros(2))
    np.testing.assert_allclose(np.arctan2(seen[:, 1], seen[:, 0]), bearing, atol=1e-14)
