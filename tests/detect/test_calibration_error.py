"""The calibration's part of discs' covariances: against cameras that are wrong, and in files."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from camera import Camera, read_camera, write_camera
from camera.model import PARAMETERS
from camera.uncertainty import with_covariance
from detect.cli import main
from detect.levelling import common_covariance
from detect.projection import level_positions
from redetect.landmarks import read_frames
from tests.camera.test_uncertainty import moved
from tests.detect.commands import Captured
from tests.detect.verticals.stages import consensus, verticals

SIGMAS = np.array(
    [1.0, 0.5, 1.0, 0.7, *[1e-9] * 5, 1e-9, 1e-9, *[1e-9] * 3, *[2e-3] * 3, 3e-3, 3e-3, 2e-3]
)
COVARIANCE = np.diag(SIGMAS**2)
FLOOR = np.array([[0.0, -1.2], [0.8, -1.8], [-1.1, -2.5]])


def exact(camera: Camera) -> Camera:
    """The camera with a covariance of zero."""
    return with_covariance(camera, np.zeros((PARAMETERS, PARAMETERS)))


def normals_of_verticals(truth: Camera, wrong: Camera) -> np.ndarray:
    """Planes through true verticals, as the wrong camera has them."""
    bearing = np.linspace(-0.6, 0.6, 25)
    ray = np.stack([np.sin(bearing), -np.cos(bearing), np.zeros(25)], axis=-1)
    low, high = (
        wrong.directions_robot(truth.project_robot(truth.centre + ray + [0, 0, z]))
        for z in (-0.5, 0.1)
    )
    normal = np.cross(low, high)
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


@pytest.mark.parametrize("by_verticals", [False, True])
def test_errors_are_as_large_as_stated(published_camera: Camera, by_verticals: bool) -> None:
    rng = np.random.default_rng(2)
    pixels = published_camera.project_floor(FLOOR)
    squared = []
    for _ in range(200):
        wrong = moved(published_camera, SIGMAS * rng.standard_normal(PARAMETERS))
        found = wrong.floor_from_pixel(pixels)
        if by_verticals:
            normal = normals_of_verticals(published_camera, wrong)
            tilt, _ = consensus(verticals(normal, 1e-8, 0.1, 1.0))
            assert tilt is not None
            found = level_positions(wrong, found, (tilt.pitch_rad, tilt.roll_rad))
        stated = common_covariance(
            with_covariance(wrong, COVARIANCE), FLOOR, 0.0, by_verticals=by_verticals
        )
        error = found - FLOOR
        squared.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(stated), error) / 2.0)
    assert np.mean(squared) == pytest.approx(1.0, abs=0.3)


def rows(path: Path) -> np.ndarray:
    return np.array(
        [(r.px, r.py, r.cxx, r.cxy, r.cyy) for f in read_frames(path) for r in f.circles]
    )


@pytest.mark.parametrize("command", ["circles", "all"])
def test_rows_state_it_and_the_command_says_its_share(
    small_run: Path, command: str, capsys: Captured
) -> None:
    (calibration,) = small_run.glob("*.cam")
    write_camera(exact(read_camera(calibration)), calibration, overwrite=True)
    assert main([command, str(small_run)]) == 0
    before = rows(small_run / "detected.circles")
    camera = with_covariance(read_camera(calibration), COVARIANCE)
    write_camera(camera, calibration, overwrite=True)
    capsys.readouterr()
    assert main([command, str(small_run), "--force"]) == 0
    told = capsys.readouterr().out
    after = rows(small_run / "detected.circles")

    by_verticals = command == "all" and _has_tilt(small_run)
    common = common_covariance(camera, before[:, :2], 0.0, by_verticals=by_verticals)
    np.testing.assert_allclose(after[:, :2], before[:, :2], atol=1e-5)
    added = after[:, 2:] - before[:, 2:]
    # Levelled rows have moved a little since their derivatives were taken.
    np.testing.assert_allclose(added[:, 0], common[:, 0, 0], rtol=0.3, atol=1e-9)
    np.testing.assert_allclose(added[:, 2], common[:, 1, 1], rtol=0.3, atol=1e-9)
    share = np.median((common[:, 0, 0] + common[:, 1, 1]) / (after[:, 2] + after[:, 4]))
    said = re.search(r"(\d+) % of the discs' variance", told)
    assert said is not None
    assert int(said[1]) == pytest.approx(100.0 * share, rel=0.3)
    head = (small_run / "detected.circles").read_text().split("STEP e", 1)[0]
    assert "covariances include the calibration's" in head


def test_what_a_calibration_does_not_state_is_assumed(published_camera: Camera) -> None:
    """Positions of pixels that are wrong by so much have this covariance."""
    pixels = published_camera.project_floor(FLOOR)
    rng = np.random.default_rng(4)
    found = published_camera.floor_from_pixel(pixels + 0.15 * rng.standard_normal((4000, 3, 2)))
    stated = common_covariance(published_camera, FLOOR, 0.15, by_verticals=False)
    for k, place in enumerate(FLOOR):
        error = found[:, k] - place
        observed = error.T @ error / len(error)
        np.testing.assert_allclose(observed, stated[k], rtol=0.1, atol=0.05 * stated[k].max())
    assert not common_covariance(exact(published_camera), FLOOR, 0.15, by_verticals=False).any()


@pytest.mark.parametrize("command", ["circles", "all"])
def test_rows_state_what_is_assumed(small_run: Path, command: str, capsys: Captured) -> None:
    (calibration,) = small_run.glob("*.cam")
    unstated = replace(read_camera(calibration), covariance=None)
    write_camera(unstated, calibration, overwrite=True)
    assert main([command, str(small_run)]) == 0
    told, after = capsys.readouterr().out, rows(small_run / "detected.circles")
    write_camera(exact(unstated), calibration, overwrite=True)
    assert main([command, str(small_run), "--force"]) == 0
    assert "calibration's" not in capsys.readouterr().out
    before = rows(small_run / "detected.circles")
    added = after[:, 2] + after[:, 4] - before[:, 2] - before[:, 4]
    common = common_covariance(unstated, before[:, :2], 0.15, by_verticals=False)
    np.testing.assert_allclose(added, np.trace(common, axis1=1, axis2=2), rtol=0.3, atol=1e-9)
    assert "error is assumed to be 0.15 px (--calibration-px)" in told


def _has_tilt(run: Path) -> bool:
    return "\nTILT " in (run / "detected.frames.tilt").read_text()
