"""Simulated runs: files, truth, determinism."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from camera import Camera, read_camera
from camera.model import PARAMETERS
from camera.uncertainty import with_covariance
from redetect.landmarks import read_frames
from redetect.slam.models import disc_in_robot
from tests.pictures import read_grey
from tools.simulator.__main__ import main
from tools.simulator.driving import tilted_camera
from tools.simulator.observation import published_covariance
from tools.simulator.runs import DEMO, RunPlan, RunSettings, plan_run, render_frame, write_rows

SETTINGS = RunSettings(name="sim", frames=25, seed=3, discs=25, lookalikes=10)


@pytest.fixture(scope="module")
def demo_folder(project_root: Path) -> Path:
    return project_root / "images" / "e"


@pytest.fixture(scope="module")
def demo_truth(demo_folder: Path) -> dict[str, Any]:
    truth: dict[str, Any] = json.loads((demo_folder / "truth.json").read_text())
    return truth


@pytest.fixture(scope="module")
def rows_plan() -> RunPlan:
    return plan_run(SETTINGS, lit=False)


@pytest.fixture(scope="module")
def rows_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rows") / "sim"
    write_rows(SETTINGS, folder, noisy=True)
    return folder


def test_demo_run_is_complete(demo_folder: Path, published_camera: Camera) -> None:
    frames = list(read_frames(demo_folder / "map.circles"))
    assert 60 <= len(frames) <= 100
    for frame in frames:
        image = cv2.imread(
            str(demo_folder / "images" / f"{frame.step.prefix}.jpg"), cv2.IMREAD_UNCHANGED
        )
        assert image is not None
        assert image.shape == (published_camera.height, published_camera.width)
        assert image.std() > 10.0
    exact = with_covariance(published_camera, np.zeros((PARAMETERS, PARAMETERS)))
    assert read_camera(demo_folder / "e.cam") == exact
    assert sum(f.stat().st_size for f in demo_folder.rglob("*")) <= 4e6
    passed = {i for frame in frames for row in frame.circles for i in row.ids if i >= 0}
    assert len(passed) >= 15
    steps = [f.step for f in frames]
    assert [f.step for f in read_frames(demo_folder / "e.txt")] == steps
    assert [f.step for f in read_frames(demo_folder / "map.lines")] == steps


@pytest.mark.parametrize("name", ["map.circles", "map.lines", "e.txt", "truth.json"])
def test_demo_run_says_that_it_is_simulated(demo_folder: Path, name: str) -> None:
    head = (demo_folder / name).read_text()[:1200]
    assert "SIMULATED" in head
    assert "DlrSpatialCognitionDataSet" in head


def test_demo_disc_rows_lie_at_the_true_places(
    demo_folder: Path, demo_truth: dict[str, Any], published_camera: Camera
) -> None:
    places = {disc["id"]: np.array(disc["xy"]) for disc in demo_truth["discs"]}
    checked = 0
    frames = read_frames(demo_folder / "map.circles")
    for frame, truth in zip(frames, demo_truth["frames"], strict=True):
        assert frame.step.prefix == truth["prefix"]
        listed = [disc for disc in truth["discs"] if disc["listed"]]
        assert len(listed) == len(frame.circles)
        camera = tilted_camera(published_camera, truth["tilt"])
        for row, disc in zip(frame.circles, listed):
            assert row.ids in ((disc["id"],), (-1,))
            robot_xy = disc_in_robot(truth["pose"], places[disc["id"]])
            np.testing.assert_allclose([row.px, row.py], robot_xy, atol=1e-5)
            pixel = camera.project_floor(robot_xy)
            np.testing.assert_allclose(pixel, disc["pixel"], atol=2e-3)
            c = published_covariance(published_camera, np.rint(pixel))
            np.testing.assert_allclose([row.cxx, row.cxy, row.cyy], c[[0, 0, 1], [0, 1, 1]],
                                       rtol=1e-5)  # fmt: skip
            checked += 1
    assert checked > 200


def test_demo_discs_are_bright_where_the_truth_says(
    demo_folder: Path, demo_truth: dict[str, Any], published_camera: Camera
) -> None:
    steps = []
    beside_m = np.array([0.15, 0.0])
    for frame, truth in zip(read_frames(demo_folder / "map.circles"), demo_truth["frames"]):
        grey = read_grey(demo_folder / "images" / f"{truth['prefix']}.jpg")
        for disc in truth["discs"]:
            if disc["listed"] and disc["share"] == 1.0:
                u, v = np.rint(disc["pixel"]).astype(int)
                beside = published_camera.project_floor(
                    published_camera.floor_from_pixel([float(u), float(v)]) + beside_m
                )
                a, b = np.rint(beside).astype(int)
                if 0 <= a < grey.shape[1] and 0 <= b < grey.shape[0]:
                    steps.append(float(grey[v, u]) - float(grey[b, a]))
        assert len(frame.circles) == sum(disc["listed"] for disc in truth["discs"])
    assert len(steps) > 150
    assert np.mean(np.array(steps) > 20.0) > 0.95


def test_demo_edges_lie_on_grey_value_edges(
    demo_folder: Path, demo_truth: dict[str, Any], published_camera: Camera
) -> None:
    edges = {edge["id"]: edge for edge in demo_truth["edges"]}
    offsets = []
    for truth in demo_truth["frames"][::4]:
        path = demo_folder / "images" / f"{truth['prefix']}.jpg"
        grey = read_grey(path)
        gradient = cv2.GaussianBlur(grey.astype(np.float64), (0, 0), 1.0)
        gradient = np.abs(np.gradient(gradient, axis=1))
        camera = tilted_camera(published_camera, truth["tilt"])
        for edge in truth["edges"]:
            if not edge["listed"] or abs(edge["contrast"]) < 30.0:
                continue
            world = edges[edge["id"]]
            z = np.linspace(world["z"][0], world["z"][1], 200)
            robot_xy = disc_in_robot(truth["pose"], world["xy"])
            uv = camera.project_robot(np.column_stack([np.tile(robot_xy, (200, 1)), z]))
            u0, v0, u1, v1 = edge["ends"]
            nearest = int(np.nanargmin(np.abs(uv[:, 1] - round(0.5 * (v0 + v1)))))
            u, v = uv[nearest, 0], round(uv[nearest, 1])
            assert min(u0, u1) - 40.0 < u < max(u0, u1) + 40.0
            if 8.0 < u < 759.0:
                window = gradient[v, round(u) - 5 : round(u) + 6]
                inner = window[1:-1]
                peaks = (inner >= window[:-2]) & (inner >= window[2:]) & (inner > 2.0)
                places = round(u) - 4 + np.flatnonzero(peaks)
                offsets.append(np.min(np.abs(places - u), initial=9.0))
    assert len(offsets) > 100
    assert np.median(offsets) < 0.5
    assert np.mean(np.array(offsets) < 1.5) > 0.95


def test_rows_are_the_truth_plus_noise_of_their_covariance(
    rows_folder: Path, rows_plan: RunPlan
) -> None:
    frames = list(read_frames(rows_folder / "map.circles"))
    count = sum(len(f.circles) for f in frames)
    assert count > 100
    squared, unlabelled = [], 0
    for k, frame in enumerate(frames):
        truth = disc_in_robot(rows_plan.poses[k + 1], rows_plan.disc_xy)
        for row in frame.circles:
            if row.ids == (-1,):
                unlabelled += 1
                continue
            index = list(rows_plan.disc_ids).index(row.ids[0])
            error = np.array([row.px, row.py]) - truth[index]
            c = np.array([[row.cxx, row.cxy], [row.cxy, row.cyy]])
            squared.append(error @ np.linalg.solve(c, error))
    total = float(np.sum(squared))
    assert chi2.ppf(1e-4, 2 * len(squared)) < total < chi2.ppf(1 - 1e-4, 2 * len(squared))
    assert 0 < unlabelled < 0.12 * count


@pytest.mark.long
def test_exact_rows_and_missed_rows(tmp_path: Path, rows_folder: Path, rows_plan: RunPlan) -> None:
    every = sum(len(frame.circles) for frame in read_frames(rows_folder / "map.circles"))
    some = write_rows(SETTINGS, tmp_path / "some", noisy=False, miss=0.3)
    assert 0.55 * every < some < 0.85 * every
    for k, frame in enumerate(read_frames(tmp_path / "some" / "map.circles")):
        truth = disc_in_robot(rows_plan.poses[k + 1], rows_plan.disc_xy)
        for row in frame.circles:
            assert np.abs(truth - [row.px, row.py]).max(axis=1).min() < 1e-5


@pytest.mark.long
def test_same_seed_same_bytes_other_seed_other_run(tmp_path: Path, rows_folder: Path) -> None:
    for name, seed in (("again", 3), ("other", 4)):
        write_rows(replace(SETTINGS, seed=seed), tmp_path / name)
    for file in ("map.circles", "sim.txt", "truth.json"):
        first = (rows_folder / file).read_bytes()
        assert first == (tmp_path / "again" / file).read_bytes()
        assert first != (tmp_path / "other" / file).read_bytes()


def test_discs_keep_apart_and_can_be_driven_past(rows_plan: RunPlan) -> None:
    xy = rows_plan.disc_xy
    apart = np.hypot(*np.moveaxis(xy[:, None] - xy[None, :], -1, 0)) + 9.0 * np.eye(len(xy))
    assert apart.min() > 0.3
    path = rows_plan.poses[:, :2]
    nearest = np.hypot(*np.moveaxis(xy[:, None] - path[None, :], -1, 0)).min(axis=1)
    assert nearest.max() < 3.0


@pytest.mark.long
def test_a_demo_frame_comes_out_again(demo_folder: Path) -> None:
    plan = plan_run(DEMO)
    truth = render_frame(plan, 41)
    assert truth.jpeg is not None
    again = cv2.imdecode(np.frombuffer(truth.jpeg, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    path = demo_folder / "images" / f"{plan.prefix(41)}.jpg"
    committed = read_grey(path)
    assert again is not None
    # Other machines may round differently in the last digit: noise and texture must not change.
    assert np.abs(again.astype(int) - committed.astype(int)).mean() < 0.05


def test_existing_run_is_not_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["rows", str(tmp_path / "run"), "--frames", "5", "--discs", "4"]
    calibration = tmp_path / "run" / "run.cam"
    calibration.parent.mkdir()
    calibration.write_text("mine")
    assert main(arguments) == 1
    assert "exists already" in capsys.readouterr().err
    assert calibration.read_text() == "mine"
    assert main([*arguments, "--force"]) == 0
    assert read_camera(calibration)
    assert len(list(read_frames(tmp_path / "run" / "map.circles"))) == 5
