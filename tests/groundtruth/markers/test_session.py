"""Sessions: images grouped by time, corners as points, and what becomes of each time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.groundtruth.commands.poses import print_left_out
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.markers.refinement import chain_points
from redetect.groundtruth.markers.session import (
    MarkerFrame,
    Network,
    find_runs,
    group_by_time,
    read_marker_frames,
    rig_views,
)
from redetect.groundtruth.markers.track import (
    PoseStatus,
    excess_of,
    report_entry,
    track_by_markers,
)
from redetect.groundtruth.settings import PoseSettings
from redetect.groundtruth.trajectories import se3
from redetect.landmarks import MarkerCorner
from tests.groundtruth.markers.scene import (
    box_rig,
    frames_of,
    hall_cameras,
    lens,
    network_of,
    robot_pose,
)
from tools.simulator.driving import planar_transform

NETWORK = Network(
    ("a", "b", "c", "d"), (lens(),) * 4, ("",) * 4, hall_cameras(4), np.zeros((24, 24))
)


def frame(camera: int, time_s: float) -> MarkerFrame:
    return MarkerFrame(camera, f"{camera}@{time_s}", time_s, ())


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 200)), max_size=30),
    st.integers(0, 20),
)
def test_groups_hold_each_camera_once_within_the_tolerance(
    images: list[tuple[int, int]], tolerance_ms: int
) -> None:
    frames = [frame(camera, ms / 1000.0) for camera, ms in images]
    groups = group_by_time(frames, tolerance_ms / 1000.0 + 1e-9)
    assert sorted(map(id, frames)) == sorted(id(f) for group in groups for f in group)
    for group in groups:
        times = [f.time_s for f in group]
        assert max(times) - min(times) <= tolerance_ms / 1000.0 + 1e-6
        assert len({f.camera for f in group}) == len(group)
    firsts = [group[0].time_s for group in groups]
    assert firsts == sorted(firsts)


def test_cameras_that_are_a_little_apart_are_used_together() -> None:
    frames = [frame(0, 1.000), frame(1, 1.004), frame(0, 1.010), frame(1, 1.013), frame(2, 1.5)]
    groups = group_by_time(frames, 0.005)
    assert [[f.camera for f in group] for group in groups] == [[0, 1], [0, 1], [2]]


def test_times_are_those_of_the_images(tmp_path: Path) -> None:
    run = tmp_path / "a"
    run.mkdir()
    (run / "detected.markers").write_text("STEP 001 0 0 0 0 0 0 0 0 0\n")
    (run / "a.times").write_text("001 1.5\n002 2.0\n")
    assert [frame.time_s for frame in read_marker_frames(run, 0)] == [1.5]
    (run / "a.times").write_text("002 2.0\n")
    with pytest.raises(GroundTruthError, match=r"a\.times: no time of image 001"):
        read_marker_frames(run, 0)
    two = "STEP 001 0 0 0 0 0 0 0 0 0\nSTEP 002 0 0 0 0 0 0 0 0 0\n"
    (run / "detected.markers").write_text(two)
    (run / "a.times").write_text("001 2.0\n002 2.0\n")  # rounded to seconds
    with pytest.raises(GroundTruthError, match="001 and 002 have one time"):
        read_marker_frames(run, 0)
    (run / "detected.markers").write_text("# a comment\rSTEP 001 0 0 0 0 0 0 0 0 0\r")
    with pytest.raises(GroundTruthError, match=r"detected\.markers: no STEP row"):
        read_marker_frames(run, 0)


def test_markers_that_are_not_on_the_rig_are_no_views() -> None:
    rig = box_rig()
    (first, *_) = [
        f for f in frames_of(np.zeros(1), np.eye(4)[None], cameras=1) if len(f.markers) > 1
    ]
    other = replace(first.markers[0], dictionary="aruco")
    unknown = replace(first.markers[1], id=300)
    views = rig_views([replace(first, markers=(other, unknown, first.markers[0]))], rig)
    assert [view.marker for view in views] == [first.markers[0]]


def test_corners_without_a_covariance_are_refused_by_image_and_marker() -> None:
    rig = box_rig()
    (first, *_) = [f for f in frames_of(np.zeros(1), np.eye(4)[None], cameras=1) if f.markers]
    corners = first.markers[0].corners
    bad = MarkerCorner(corners[2].u, corners[2].v, 0.01, 0.02, 0.01)
    marker = replace(first.markers[0], corners=(corners[0], corners[1], bad, corners[3]))
    views = rig_views([replace(first, markers=(marker,))], rig)
    with pytest.raises(GroundTruthError, match=f"image 0000, marker {marker.id}: the covariance"):
        chain_points(views, rig, 0.01)
    zero = MarkerCorner(corners[2].u, corners[2].v, 0.0, 0.0, 0.0)
    exact = replace(first.markers[0], corners=(corners[0], corners[1], zero, corners[3]))
    views = rig_views([replace(first, markers=(exact,))], rig)
    points = chain_points(views, rig, 0.01)  # the floor is all that is left
    np.testing.assert_allclose(points.covariances[2], 1e-4 * np.eye(2))


def test_every_time_is_accounted_for() -> None:
    """Clear, unseen, and a lone frontal marker that its neighbours decide."""
    rig = box_rig()
    camera = hall_cameras(1)[0]
    bearing = float(np.arctan2(camera[1, 3] - 1.5, camera[0, 3] - 1.5))
    times = np.arange(12) / 10.0
    poses = np.stack([planar_transform(1.5, 1.5, bearing + 0.05 * (i - 6)) for i in range(12)])
    frames = frames_of(times, poses, cameras=1, sigma_px=0.3, scale_px=500.0, seed=3)
    for i in range(4, 9):
        only = tuple(m for m in frames[i].markers if m.id == 31)
        frames[i] = replace(frames[i], markers=only)
    frames[1] = replace(frames[1], markers=())
    network = replace(NETWORK, cameras=(lens(500.0),) * 4)
    track = track_by_markers(group_by_time(frames, 0.005), rig, network, PoseSettings())
    assert track.counts[PoseStatus.UNSEEN] == 1
    assert track.counts[PoseStatus.RESOLVED] >= 2
    assert sum(track.counts.values()) == 12
    for tracked, truth in zip(track.times, poses):
        entry = report_entry(tracked, network)
        assert entry["status"] == tracked.status
        assert entry["images"] == {"a": tracked.images[0].prefix}
        if tracked.status == "resolved":
            assert "planar ambiguity, decided by the neighbours" in entry["reason"]
            assert len(entry["candidates"]) > 1
            assert entry["margin"] > np.log(1000.0)
        if tracked.pose is not None:
            wrong = np.linalg.norm(se3.log(se3.inverse(truth) @ tracked.pose.world_from_robot)[3:])
            assert np.degrees(wrong) < 10.0
    planar = track.planar()
    assert len(planar) == sum(t.pose is not None for t in track.times)
    assert planar.covariances is not None
    assert np.linalg.eigvalsh(planar.covariances).min() > 0.0


def test_an_undecided_time_has_no_pose() -> None:
    """The same lone marker without anybody to decide: reported, not written."""
    rig = box_rig()
    camera = hall_cameras(1)[0]
    bearing = float(np.arctan2(camera[1, 3] - 1.5, camera[0, 3] - 1.5))
    pose = planar_transform(1.5, 1.5, bearing)[None]
    network = replace(NETWORK, cameras=(lens(500.0),) * 4)
    undecided = 0
    for seed in range(8):
        (only,) = frames_of(np.zeros(1), pose, cameras=1, sigma_px=0.3, scale_px=500.0, seed=seed)
        only = replace(only, markers=tuple(m for m in only.markers if m.id == 31))
        track = track_by_markers([(only,)], rig, network, PoseSettings())
        if track.times[0].status == "unresolved":
            undecided += 1
            assert len(track.planar()) == 0
            assert "not decided" in report_entry(track.times[0], network)["reason"]
    assert undecided > 2


def test_runs_are_found_in_a_session(tmp_path: Path) -> None:
    for name in ("b", "a", "other"):
        (tmp_path / name).mkdir()
    for name in ("a", "b"):
        (tmp_path / name / "detected.markers").touch()
    assert find_runs(tmp_path) == [tmp_path / "a", tmp_path / "b"]


def test_poses_from_markers_printed_too_large_say_that_they_are_off() -> None:
    """Widths 3 % wrong: the residuals contradict the covariances, which are raised."""
    rig, cameras = box_rig(), hall_cameras(2)
    rng = np.random.default_rng(8)
    poses = np.stack([robot_pose(rng, 0.5) for _ in range(12)])
    times = np.arange(12.0)
    groups = group_by_time(frames_of(times, poses, cameras=2, rig=rig), 0.005)
    network = network_of(cameras)
    for width, few, many in ((1.0, 0, 1), (1.03, 10, 12)):
        wrong = replace(rig, widths_m=width * rig.widths_m)
        track = track_by_markers(groups, wrong, network, PoseSettings())
        raised = [excess_of(pose) for _, pose in track.posed]
        assert few <= sum(one > 1.0 for one in raised) <= many
        found = track.planar()
        truth = np.column_stack([poses[:, 0, 3], poses[:, 1, 3]])[found.times_s.astype(int)]
        error = found.poses[:, :2] - truth
        assert found.covariances is not None
        own = np.linalg.inv(found.covariances[:, :2, :2])
        assert np.mean(np.einsum("ni,nij,nj->n", error, own, error)) / 2.0 < 1.8


def test_a_marker_or_camera_in_another_place_than_its_file_says_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = box_rig()
    places = rig.robot_from_marker.copy()
    places[2, 0, 3] += 0.05
    wrong = replace(rig, robot_from_marker=places)
    network = network_of(hall_cameras(4))
    moved = hall_cameras(4)
    moved[1, 0, 3] += 0.05
    rng = np.random.default_rng(9)
    poses = np.stack([robot_pose(rng, 0.5) for _ in range(4)])
    groups = group_by_time(frames_of(np.arange(4.0), poses, rig=rig), 0.005)
    for used, cameras, widths, expected in (
        (rig, network, 1.0, ""),
        (wrong, network, 1.0, f"disagree: the pose of marker {rig.ids[2]}, or else "),
        (rig, network_of(moved), 1.0, "disagree: the pose or clock of camera b, or else "),
        (rig, network, 1.05, "disagree: poses or widths of markers, in rig.json"),
    ):
        used = replace(used, widths_m=widths * used.widths_m)
        # Markers that are 5 % larger and as much farther apart: a rig of another scale.
        places = used.robot_from_marker.copy()
        places[:, :3, 3] *= widths
        used = replace(used, robot_from_marker=places)
        track = track_by_markers(groups, used, cameras, PoseSettings())
        print_left_out(track, cameras, Path("rig.json"), Path("network.json"))
        assert expected in capsys.readouterr().err
