"""Pictures: what they are drawn from is right, they are the same bytes again, nothing is lost."""

from __future__ import annotations

from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
import pytest

from redetect.array_types import BoolArray, FloatArray
from redetect.landmarks.map_file import LandmarkMap, MapLandmarks, Path2D, no_landmarks
from redetect.plane import ellipses
from redetect.slam.errors import SlamError
from redetect.slam.pictures import (
    NEES_BAND,
    Crop,
    draw_crops,
    draw_errors,
    draw_map,
    pose_errors,
)

DISC_BGR = (0x1E, 0x50, 0xC8)


def landmarks(xy: FloatArray, covariance: FloatArray | None = None) -> MapLandmarks:
    count = len(xy)
    spread = np.tile(1e-4 * np.eye(2), (count, 1, 1)) if covariance is None else covariance
    return MapLandmarks(np.arange(count), xy, spread, np.full(count, 3))


def some_path(count: int = 60, scale: float = 0.2) -> Path2D:
    angle = np.linspace(0.0, 3.0, count)
    poses = np.column_stack([scale * 9 * np.sin(angle), -scale * 9 * angle, angle])
    spread = np.tile(np.diag([1e-4, 4e-4, 1e-5]), (count, 1, 1))
    return Path2D(("start", *(f"p{k}" for k in range(1, count))), poses, spread)


def pixels_like(png: Path, bgr: tuple[int, int, int]) -> BoolArray:
    image = cv2.imread(str(png), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(np.all(np.abs(image.astype(int) - bgr) < 12, axis=2))


def test_an_outline_has_the_mahalanobis_distance_asked_for() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(30, 2, 2))
    covariance, centre = root @ np.swapaxes(root, 1, 2), rng.normal(size=(30, 2))
    offset = ellipses(centre, covariance, 3.0) - centre[:, None]
    squared = np.einsum("mki,mij,mkj->mk", offset, np.linalg.inv(covariance), offset)
    np.testing.assert_allclose(squared, 9.0, rtol=1e-9)


def test_errors_are_wrapped_and_normalised() -> None:
    path = some_path(4)
    assert path.covariance is not None
    path.covariance[0] = 0.0  # a start that is given
    truth = path.poses.copy()
    truth[1] += [0.01, 0.0, 2 * np.pi]
    truth[2] += [0.0, 0.02, 0.0]
    error, sigma, nees = pose_errors(path, truth)
    np.testing.assert_allclose(error[1], [-0.01, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(sigma[1], [0.01, 0.02, np.sqrt(1e-5)])
    assert np.isnan(nees[0])
    np.testing.assert_allclose(nees[1:], [1.0, 1.0, 0.0], atol=1e-9)


def test_the_band_is_that_of_chi_squared() -> None:
    from scipy.stats import chi2

    np.testing.assert_allclose(NEES_BAND, chi2.ppf([0.025, 0.975], 3), rtol=1e-12)


@pytest.mark.long
def test_the_same_map_again_whatever_the_users_settings() -> None:
    path = some_path()
    some = LandmarkMap(landmarks(path.poses[::6, :2] + 0.5), landmarks(path.poses[::9, :2] - 1.0))
    first = draw_map(some, path, before=(some, path), reference=path)
    with mpl.rc_context({"font.size": 23.0, "lines.linewidth": 9.0, "savefig.dpi": 30}):
        second = draw_map(some, path, before=(some, path), reference=path)
        assert mpl.rcParams["font.size"] == 23.0
    assert first == second
    assert b"atplotlib" not in first


@pytest.mark.long
def test_the_same_errors_again() -> None:
    path = some_path()
    first, second = (draw_errors(path, path.poses + 0.01, title="a") for _ in range(2))
    assert first == second


def test_axes_are_equally_scaled(tmp_path: Path) -> None:
    """A round ellipse is as wide as high in the picture, also where the path is not."""
    path = Path2D(("start", "a"), np.array([[0.0, 0.0, 0.0], [0.0, -30.0, 0.0]]))
    spread = 0.25 * np.eye(2)[None]
    some = LandmarkMap(landmarks(np.array([[0.5, -15.0]]), spread), no_landmarks())
    (tmp_path / "m.png").write_bytes(draw_map(some, path))
    rows, columns = np.nonzero(pixels_like(tmp_path / "m.png", DISC_BGR))
    inside = rows < 0.85 * rows.max() if rows.max() > 0 else rows >= 0  # without the legend
    high, wide = np.ptp(rows[inside]), np.ptp(columns[inside])
    assert high > 80
    assert abs(high - wide) <= 2


def test_a_vertical_far_outside_does_not_shrink_the_picture(tmp_path: Path) -> None:
    path = some_path()
    discs = landmarks(path.poses[::6, :2])
    near = np.array([[3.0, -3.0], [-2.0, -1.0]])
    wide = LandmarkMap(discs, landmarks(np.concatenate([near, [[900.0, 0.0]]])))
    (tmp_path / "near.png").write_bytes(draw_map(LandmarkMap(discs, landmarks(near)), path))
    (tmp_path / "wide.png").write_bytes(draw_map(wide, path))
    shares = [
        np.ptp(np.nonzero(pixels_like(tmp_path / name, DISC_BGR))[0])
        for name in ("near.png", "wide.png")
    ]
    assert abs(int(shares[0]) - int(shares[1])) <= 30
    assert shares[0] > 300


def test_verticals_may_all_be_outside() -> None:
    path = some_path(9)
    far = LandmarkMap(landmarks(path.poses[:, :2]), landmarks(np.array([[900.0, 0.0]])))
    assert draw_map(far, path)


def test_a_path_of_one_pose_is_drawn() -> None:
    path = Path2D(("start",), np.zeros((1, 3)))
    nothing = LandmarkMap(no_landmarks(), no_landmarks())
    of_map = draw_map(nothing, path, before=(nothing, path))
    perfect = Path2D(path.prefixes, path.poses, np.zeros((1, 3, 3)))
    for drawn in (of_map, draw_errors(perfect, path.poses)):
        image = cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        assert image.shape[0] > 300


def test_what_is_no_image_has_no_crop(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"<html>")
    with pytest.raises(SlamError, match=r"a\.png: cannot be decoded"):
        draw_crops([Crop(tmp_path / "a.png", (1.0, 1.0), "a")], "a group")


def test_no_window_without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mpl, "get_backend", lambda: "agg")
    with pytest.raises(SlamError, match="no window can be opened here"):
        draw_errors(some_path(), some_path().poses, interactive=True)


def test_a_window_shows_what_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib import pyplot

    shown: list[int] = []
    monkeypatch.setattr(mpl, "get_backend", lambda: "qtagg")
    monkeypatch.setattr(pyplot, "show", lambda: shown.append(len(pyplot.get_fignums())))
    path = some_path(9)
    first, second = (draw_errors(path, path.poses, interactive=yes) for yes in (True, False))
    assert shown == [1]
    assert pyplot.get_fignums() == []
    assert first == second
