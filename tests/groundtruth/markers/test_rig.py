"""Rigs from images of several markers: consensus, bridges, adjustment, the robot's frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.markers.pairs import (
    MarkerPose,
    chained_poses,
    pair_consensus,
    pair_estimates,
)
from redetect.groundtruth.markers.rig_estimation import (
    RigEstimate,
    estimate_rig,
)
from redetect.groundtruth.markers.session import MarkerFrame, Rig
from redetect.groundtruth.report.pictures import draw_rig
from redetect.groundtruth.settings import RigSettings
from redetect.groundtruth.trajectories import se3
from tests.groundtruth.markers.scene import (
    box_rig,
    frames_of,
    hall_cameras,
    lens,
    marker_rows,
    network_of,
    points_of,
    visible,
)
from tools.simulator.driving import planar_transform
from tools.simulator.markers.room import looking_at

FloatArray = NDArray[np.float64]


def walk_round(
    rig: Rig,
    count: int,
    *,
    seed: int,
    sigma_px: float = 0.15,
    scale_px: float = 900.0,
    distance_m: tuple[float, float] = (1.5, 3.5),
    kept: tuple[set[int], ...] | None = None,
) -> list[tuple[MarkerFrame]]:
    """A hand-held camera round a standing robot; `kept` limits what an image shows."""
    generator = np.random.default_rng(seed)
    camera = (lens(scale_px),)
    groups: list[tuple[MarkerFrame]] = []
    while len(groups) < count:
        bearing = generator.uniform(-np.pi, np.pi)
        distance = generator.uniform(*distance_m)
        place = np.array(
            [distance * np.cos(bearing), distance * np.sin(bearing), generator.uniform(0.6, 2.2)]
        )
        pose = looking_at(place, np.array([0.0, 0.0, 0.55]) + generator.normal(0, 0.1, 3))[None]
        pairs = visible(camera, pose, np.eye(4), rig, steepest_deg=78.0)
        if kept is not None:
            allowed = kept[len(groups) % len(kept)]
            pairs = [(c, m) for c, m in pairs if m in allowed]
        if len(pairs) < 2:
            continue
        seen, _ = points_of(pairs, camera, pose, np.eye(4), rig, sigma_px=sigma_px, noise=generator)
        rows = marker_rows(rig, pairs, 0, seen)
        groups.append((MarkerFrame(0, f"{len(groups):04d}", float(len(groups)), rows),))
    return groups


def estimated(
    groups: list[tuple[MarkerFrame]],
    rig: Rig,
    scale_px: float = 900.0,
    reference: int | None = None,
    known: Rig | None = None,
) -> RigEstimate:
    return estimate_rig(
        groups,
        network_of(np.eye(4)[None], scale_px=scale_px),
        float(rig.widths_m[0]),
        RigSettings(corner_floor_px=0.0),
        reference=reference,
        known=known,
    )


def truth_in(rig: Rig, reference: int) -> FloatArray:
    root = rig.ids.index(reference)
    return se3.inverse(rig.robot_from_marker[root]) @ rig.robot_from_marker


def normalised_error(estimate: RigEstimate, rig: Rig, covariance: FloatArray) -> tuple[float, int]:
    error = se3.log(se3.inverse(truth_in(rig, estimate.reference)) @ estimate.rig.robot_from_marker)
    free = np.repeat(np.array(rig.ids) != estimate.reference, 6)
    vector = error.ravel()[free]
    return float(vector @ np.linalg.solve(covariance[np.ix_(free, free)], vector)), int(free.sum())


def test_the_rig_comes_back_without_noise() -> None:
    rig = box_rig()
    estimate = estimated(walk_round(rig, 25, seed=1, sigma_px=1e-7), rig)
    np.testing.assert_allclose(
        estimate.rig.robot_from_marker, truth_in(rig, estimate.reference), atol=1e-7
    )
    assert estimate.rig.ids == rig.ids
    assert not estimate.left_out


def test_a_free_camera_can_be_the_reference() -> None:
    rig = box_rig()
    groups = walk_round(rig, 20, seed=2)
    estimate = estimated(groups, rig, reference=35)
    assert estimate.reference == 35
    np.testing.assert_array_equal(estimate.rig.robot_from_marker[4], np.eye(4))
    with pytest.raises(GroundTruthError, match="marker 99 cannot be the reference"):
        estimated(groups, rig, reference=99)


@pytest.mark.long
def test_the_rigs_covariance_is_true() -> None:
    rig = box_rig()
    squares, freedom = 0.0, 0
    for seed in range(5):  # 150 degrees of freedom: the sum is known to 12 %
        estimate = estimated(walk_round(rig, 25, seed=100 + seed), rig)
        square, dof = normalised_error(estimate, rig, estimate.adjusted.part_covariance)
        squares, freedom = squares + square, freedom + dof
        assert estimate.adjusted.chi2_per_dof == pytest.approx(1.0, abs=0.2)
        assert estimate.adjusted.used.all()
    low, high = chi2.ppf([0.005, 0.995], freedom)
    assert low < squares < high


@pytest.mark.long
def test_wrong_solutions_of_small_markers_do_not_reach_the_rig() -> None:
    """Far, frontal, noisy: the better fitting solution is often the mirror image."""
    rig = box_rig()
    groups = walk_round(rig, 60, seed=3, sigma_px=0.4, scale_px=500.0, distance_m=(3.0, 4.5))
    estimate = estimated(groups, rig, scale_px=500.0)
    second = sum(int((p.agrees & ~p.first).sum()) for p in estimate.pairs.values())
    assert second > 10  # it does happen
    square, dof = normalised_error(estimate, rig, estimate.adjusted.part_covariance)
    assert square / dof < 2.5
    error = se3.log(se3.inverse(truth_in(rig, estimate.reference)) @ estimate.rig.robot_from_marker)
    assert np.abs(error).max() < 0.03


def test_a_consensus_stands_thirty_percent_of_flipped_solutions() -> None:
    generator = np.random.default_rng(4)
    truth = se3.exp(np.array([0.3, 0.1, -0.2, 0.4, 1.2, -0.3]))
    sigma = np.array([0.003, 0.003, 0.01, 0.02, 0.02, 0.01])
    covariance = np.diag(sigma**2)
    for flipped in (0.3, 0.45):
        times = []
        for _ in range(60):
            near = truth @ se3.exp(sigma * generator.normal(size=6))
            # A mirror image depends on where the camera stood: everywhere else.
            flip = near @ se3.exp(
                np.concatenate([generator.normal(0, 0.05, 3), generator.normal(0, 0.6, 3)])
            )
            others = [near @ se3.exp(generator.normal(0, 0.5, 6)) for _ in range(2)]
            first_is_wrong = generator.random() < flipped
            poses = np.stack(
                [flip if first_is_wrong else near, near if first_is_wrong else flip, *others]
            )
            times.append(
                MarkerPose(poses, np.tile(covariance, (4, 1, 1)), np.array([1.0, 2.0, 4.0, 6.0]))
            )
        consensus = pair_consensus(times)
        error = se3.log(se3.inverse(truth) @ consensus.a_from_b)
        assert np.all(np.abs(error) < 4 * sigma / np.sqrt(60) + 1e-3)
        assert consensus.support >= 57
        assert 0.55 - flipped < consensus.first.mean() < 1.15 - flipped


def test_a_consensus_stands_misread_markers() -> None:
    """Times without any right estimate are outvoted and said not to agree."""
    generator = np.random.default_rng(5)
    truth = se3.exp(np.array([0.3, 0.1, -0.2, 0.4, 1.2, -0.3]))
    covariance = np.tile(np.diag(np.full(6, 0.01) ** 2), (1, 1, 1))
    times = [
        MarkerPose(
            (
                se3.exp(generator.normal(0, 1.0, 6))
                if i % 3 == 0
                else truth @ se3.exp(generator.normal(0, 0.01, 6))
            )[None],
            covariance,
            np.zeros(1),
        )
        for i in range(30)
    ]
    consensus = pair_consensus(times)
    assert consensus.agrees.tolist() == [i % 3 != 0 for i in range(30)]


def test_estimates_of_a_pair_are_all_combinations() -> None:
    generator = np.random.default_rng(6)
    poses = se3.exp(generator.normal(size=(4, 6)))
    covariances = np.tile(np.eye(6) * 1e-4, (2, 1, 1))
    a = MarkerPose(poses[:2], covariances, np.array([1.0, 3.0]))
    b = MarkerPose(poses[2:], covariances, np.array([0.0, 5.0]))
    pairs = pair_estimates(a, b)
    np.testing.assert_allclose(pairs.poses[2], se3.inverse(poses[1]) @ poses[2], atol=1e-12)
    np.testing.assert_array_equal(pairs.costs, [1.0, 6.0, 3.0, 8.0])


def test_markers_never_seen_together_are_bridged_by_a_third() -> None:
    rig = box_rig()
    # No image shows 31 with 33 or 34, nor 32 with 34; 36 is seen with 33 only.
    kept = ({0, 4}, {4, 1}, {1, 5}, {5, 2}, {2, 3})
    estimate = estimated(walk_round(rig, 40, seed=7, kept=kept), rig, reference=31)
    assert set(estimate.pairs) == {(0, 4), (1, 4), (1, 5), (2, 5), (2, 3)}
    square, dof = normalised_error(estimate, rig, estimate.adjusted.part_covariance)
    assert square / dof < 2.0


def test_a_marker_that_is_not_connected_is_left_out_and_named() -> None:
    rig = box_rig()
    kept = ({0, 4}, {4, 1}, {2, 3})
    estimate = estimated(walk_round(rig, 30, seed=8, kept=kept), rig, reference=31)
    assert estimate.rig.ids == (31, 32, 35)
    assert set(estimate.left_out) == {33, 34}
    assert "not 3 times in agreement" in estimate.left_out[33]
    with pytest.raises(GroundTruthError, match="no two markers were seen together"):
        estimated(walk_round(rig, 2, seed=9, kept=({0, 4},)), rig)


def test_a_misread_marker_is_left_out_of_the_adjustment() -> None:
    rig = box_rig()
    groups = walk_round(rig, 30, seed=10)
    (frame,) = groups[5]
    assert len(frame.markers) > 1
    wrong = replace(
        frame.markers[0],
        corners=tuple(  # type: ignore[arg-type]
            replace(c, u=c.u + 40.0) for c in frame.markers[0].corners
        ),
    )
    groups[5] = (replace(frame, markers=(wrong, *frame.markers[1:])),)
    clean = estimated(walk_round(rig, 30, seed=10), rig)
    estimate = estimated(groups, rig)
    assert not estimate.adjusted.used.all()
    error = se3.log(se3.inverse(clean.rig.robot_from_marker) @ estimate.rig.robot_from_marker)
    assert np.abs(error).max() < 2e-3


def turning_before_a_network(
    rig: Rig, width_m: float, *, count: int = 12, sigma_px: float = 0.1
) -> RigEstimate:
    """A rig from images of four cameras that are calibrated to each other."""
    generator = np.random.default_rng(11)
    times = np.arange(float(count))
    places = generator.normal(0, 0.5, (count, 2)).tolist()
    poses = np.stack([planar_transform(x, y, 0.5 * i) for i, (x, y) in enumerate(places)])
    frames = frames_of(times, poses, rig=rig, sigma_px=sigma_px)
    groups = [tuple(f for f in frames if f.time_s == t) for t in times]
    settings = RigSettings(corner_floor_px=0.0)
    return estimate_rig(groups, network_of(hall_cameras(4)), width_m, settings)


@pytest.mark.long
def test_cameras_of_a_network_see_the_rig_together() -> None:
    """With two cameras calibrated to each other, markers of different images are a pair."""
    rig = box_rig(4)
    estimate = turning_before_a_network(rig, float(rig.widths_m[0]), count=30)
    assert (0, 2) in estimate.pairs  # front and back: no single camera sees both
    square, dof = normalised_error(estimate, rig, estimate.adjusted.part_covariance)
    assert square / dof < 2.0


@pytest.mark.parametrize("stated_m", [0.24, 0.2412, 0.252])
def test_the_cameras_of_a_network_tell_the_markers_width(stated_m: float) -> None:
    found, sigma = turning_before_a_network(box_rig(4), stated_m).fitting_width_m
    assert found == pytest.approx(0.24, abs=4.0 * sigma)
    assert sigma < 1e-3
    rig = box_rig(4)
    alone = estimated(walk_round(rig, 8, seed=1), replace(rig, widths_m=np.full(4, stated_m)))
    assert np.isinf(alone.fitting_width_m[1])  # a larger rig farther away looks the same


def test_estimates_of_one_time_count_once() -> None:
    """A small marker, seen at its place by no two cameras, has no support by their number."""
    rig = box_rig(5)
    rig = replace(rig, widths_m=np.array([0.24] * 4 + [0.18]))
    estimate = turning_before_a_network(rig, 0.24)
    assert set(estimate.left_out) == {35}
    assert max(len(pair.agrees) for pair in estimate.pairs.values()) <= 12
    square, dof = normalised_error(estimate, box_rig(4), estimate.adjusted.part_covariance)
    assert square / dof < 2.0


# -- the robot's frame ----------------------------------------------------------------------


def frame_error(estimate: RigEstimate, rig: Rig, known: tuple[int, ...] = ()) -> float:
    """Normalised error squared per degree of freedom of all markers but the known ones."""
    error = se3.log(se3.inverse(rig.robot_from_marker) @ estimate.rig.robot_from_marker)
    free = np.repeat(~np.isin(rig.ids, known), 6)
    vector = error.ravel()[free]
    covariance = estimate.adjusted.part_covariance[np.ix_(free, free)]
    return float(vector @ np.linalg.solve(covariance, vector)) / len(vector)


def test_the_frame_follows_from_known_markers() -> None:
    rig = box_rig()
    exact = Rig("rawseeds", (33,), rig.widths_m[2:3], rig.robot_from_marker[2:3], np.zeros((6, 6)))
    groups = walk_round(rig, 25, seed=12)
    moved = estimated(groups, rig, known=exact)
    np.testing.assert_allclose(moved.rig.robot_from_marker[2], rig.robot_from_marker[2], atol=1e-5)
    assert frame_error(moved, rig, (33,)) < 2.0
    # What the others were chained to is as unsure as anything else.
    assert moved.reference != 33
    sigmas = np.sqrt(np.diagonal(moved.adjusted.part_covariance)).reshape(6, 6)
    assert sigmas[rig.ids.index(moved.reference)].min() > 1e-5
    other = Rig("rawseeds", (77,), rig.widths_m[:1], rig.robot_from_marker[:1], np.zeros((6, 6)))
    with pytest.raises(GroundTruthError, match="none of \\[77\\]"):
        estimated(groups, rig, known=other)
    with pytest.raises(GroundTruthError, match=r"marker 33 of aruco is .* expected rawseeds"):
        estimated(groups, rig, known=replace(exact, dictionary="aruco"))
    with pytest.raises(GroundTruthError, match=r"marker 33 of rawseeds is 0\.5 m wide: expected"):
        estimated(groups, rig, known=replace(exact, widths_m=np.array([0.5])))


def test_several_measured_markers_define_the_frame_together() -> None:
    rig = box_rig()
    generator = np.random.default_rng(13)
    sigmas = np.array([2e-3] * 3 + [5e-3] * 3)
    groups = walk_round(rig, 40, seed=13)
    measured = replace(
        rig,
        robot_from_marker=rig.robot_from_marker @ se3.exp(sigmas * generator.normal(size=(6, 6))),
        covariance=np.diag(np.tile(sigmas**2, 6)),
    )
    moved = estimated(groups, rig, known=measured)
    assert frame_error(moved, rig) < 2.0


# -- parts ----------------------------------------------------------------------------------


def test_the_tree_prefers_support() -> None:
    pairs = {(0, 1): 5, (0, 2): 50, (1, 2): 40, (3, 4): 9}
    poses = se3.exp(np.random.default_rng(4).normal(size=(3, 6)))
    relative = {(a, b): se3.inverse(poses[a]) @ poses[b] for a, b in ((0, 2), (1, 2))}
    relative |= {(0, 1): np.eye(4), (3, 4): np.eye(4)}
    found = chained_poses(relative, pairs, 5, 0)
    np.testing.assert_allclose(found[:3], se3.inverse(poses[0]) @ poses, atol=1e-12)
    assert np.all(np.isnan(found[3:]))


def test_the_mean_of_poses_weights_by_covariance() -> None:
    generator = np.random.default_rng(15)
    truth = se3.exp(generator.normal(size=6))
    roots = generator.normal(0, 0.01, (400, 6, 6))
    poses = np.stack([truth @ se3.exp(root @ generator.normal(size=6)) for root in roots])
    covariances = roots @ roots.transpose(0, 2, 1) + 1e-9 * np.eye(6)
    mean, covariance = se3.mean_pose(poses, covariances)
    error = se3.log(se3.inverse(truth) @ mean)
    assert error @ np.linalg.solve(covariance, error) < 25.0


def test_the_picture_is_a_png_and_always_the_same() -> None:
    rig = box_rig()
    estimate = estimated(walk_round(rig, 12, seed=16), rig)
    picture = draw_rig(estimate)
    assert picture.startswith(b"\x89PNG")
    assert picture == draw_rig(estimate)
