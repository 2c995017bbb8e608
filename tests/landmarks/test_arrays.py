"""Records as arrays and back."""

from __future__ import annotations

import numpy as np
import pytest

from redetect.landmarks import (
    CircleLandmark,
    LandmarkError,
    circle_arrays,
    circle_landmarks,
    is_positive_definite,
)

ROWS = (
    CircleLandmark(0.5, -2.0, 0.9, 0.002, 0.0005, 0.003, (7, 8)),
    CircleLandmark(-0.25, -1.0, 0.75, 0.001, -0.0001, 0.004, (-1,)),
    CircleLandmark(0.0, -3.0, 0.625, 0.001, 0.0, 0.005),
)


def test_arrays_hold_the_rows() -> None:
    arrays = circle_arrays(ROWS)
    np.testing.assert_array_equal(arrays.xy, [[0.5, -2.0], [-0.25, -1.0], [0.0, -3.0]])
    np.testing.assert_array_equal(arrays.quality, [0.9, 0.75, 0.625])
    np.testing.assert_array_equal(arrays.covariance[1], [[0.001, -0.0001], [-0.0001, 0.004]])
    np.testing.assert_array_equal(arrays.ids, [7, -1, -1])
    assert arrays.ids.dtype == np.int64


def test_no_rows_give_empty_arrays_of_the_right_shapes() -> None:
    arrays = circle_arrays([])
    assert arrays.xy.shape == (0, 2)
    assert arrays.quality.shape == (0,)
    assert arrays.covariance.shape == (0, 2, 2)
    assert arrays.ids.shape == (0,)
    assert circle_landmarks(arrays.xy, arrays.quality, arrays.covariance, arrays.ids) == ()


def test_rows_come_back_from_their_arrays() -> None:
    single = ROWS[1:2]
    arrays = circle_arrays(single)
    rows = circle_landmarks(arrays.xy, arrays.quality, arrays.covariance, arrays.ids)
    assert rows == single
    assert type(rows[0].px) is float
    without_ids = circle_landmarks(arrays.xy, arrays.quality, arrays.covariance)
    assert without_ids[0].ids == ()


def test_arrays_that_do_not_fit_together_are_refused() -> None:
    xy, quality, covariance = np.zeros((2, 2)), np.zeros(2), np.zeros((2, 2, 2))
    with pytest.raises(ValueError, match="must match exactly"):
        circle_landmarks(xy, np.zeros(3), covariance)
    with pytest.raises(ValueError, match="shorter"):
        circle_landmarks(xy, quality, covariance, [1])
    with pytest.raises(LandmarkError, match="py is nan"):
        circle_landmarks(np.array([[0, 0], [0, np.nan]]), quality, covariance)


def test_positive_definite_matrices_are_told_from_the_others() -> None:
    good = [[2.0, 1.0], [1.0, 2.0]]
    singular = [[1.0, 1.0], [1.0, 1.0]]
    indefinite = [[1.0, 2.0], [2.0, 1.0]]
    negative = [[-1.0, 0.0], [0.0, -1.0]]
    matrices = np.array([good, singular, indefinite, negative, np.zeros((2, 2)).tolist()])
    assert is_positive_definite(matrices).tolist() == [True, False, False, False, False]
    assert is_positive_definite(1e-12 * np.array(good))
    assert is_positive_definite(np.diag([1e-8, 1e-6, 1e-5]))
    assert is_positive_definite(np.zeros((0, 2, 2))).shape == (0,)
