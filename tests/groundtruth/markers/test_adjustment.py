"""Bundle adjustment: derivatives, elimination of bodies, and SciPy's minimum and covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.markers.adjustment import (
    Bundle,
    ChainPoints,
    PosePrior,
    adjust_bundle,
    linearised,
)
from redetect.groundtruth.trajectories import se3
from tests.groundtruth.markers.scene import (
    box_rig,
    hall_cameras,
    lens,
    points_of,
    robot_pose,
    visible,
)

FloatArray = NDArray[np.float64]
SIGMA_PX = 0.2


def watched_robot(
    *,
    seed: int = 1,
    times: int = 7,
    free_cameras: bool = True,
    free_bodies: bool = True,
    free_parts: bool = True,
    off: float = 0.01,
) -> Bundle:
    """A robot with markers before four cameras; the start is wrong by some centimetres."""
    generator = np.random.default_rng(seed)
    rig, cameras, world_from_camera = box_rig(), (lens(),) * 4, hall_cameras(4)
    bodies: list[FloatArray] = []
    pieces: list[ChainPoints] = []
    views: list[NDArray[np.int64]] = []
    while len(bodies) < times:
        pose = robot_pose(generator)
        pairs = visible(cameras, world_from_camera, pose, rig)
        if len(pairs) < 3:
            continue
        seen, view = points_of(
            pairs, cameras, world_from_camera, pose, rig, sigma_px=SIGMA_PX, noise=generator
        )
        pieces.append(replace(seen, body=np.full(len(seen), len(bodies))))
        views.append(view + (int(views[-1].max()) + 1 if views else 0))
        bodies.append(pose)
    seen = ChainPoints(
        *(
            np.concatenate([getattr(piece, name) for piece in pieces])
            for name in ("camera", "body", "part", "points", "pixels", "covariances")
        )
    )
    # Points in another order than their poses: what belongs together need not stand together.
    order = generator.permutation(len(seen))

    def disturbed(poses: FloatArray, free: NDArray[np.bool_]) -> FloatArray:
        steps = generator.normal(0.0, off, (len(poses), 6)) * free[:, None]
        return np.asarray(poses @ se3.exp(steps))

    of_parts = [False] + [free_parts] * (len(rig.ids) - 1)
    free = np.array([False, *[free_cameras] * 3, *of_parts, *[free_bodies] * times])
    parts, body = 4, 4 + len(rig.ids)
    priors: list[PosePrior] = []
    if free_cameras:
        known = world_from_camera[2] @ se3.exp(generator.normal(0.0, 1e-3, 6))
        priors.append(PosePrior(2, known, 1e-6 * np.diag([1, 2, 3, 1, 1, 1.0])))
    if free_parts:
        known = rig.robot_from_marker[3] @ se3.exp(generator.normal(0.0, 1e-3, 6))
        priors.append(PosePrior(parts + 3, known, 1e-6 * np.eye(6)))
    if free_bodies:
        priors.append(PosePrior(body + 4, bodies[4], 1e-6 * np.eye(6)))
    return Bundle(
        cameras,
        len(rig.ids),
        disturbed(np.concatenate([world_from_camera, rig.robot_from_marker, bodies]), free),
        free,
        seen.only(order),
        np.concatenate(views)[order],
        tuple(priors),
    )


def dense_jacobian(bundle: Bundle) -> FloatArray:
    """By central differences."""
    step = 1e-6
    columns = []
    for k in range(bundle.unknowns):
        d = step * np.eye(bundle.unknowns)[k]
        change = [linearised(bundle.moved(sign * d)).residual for sign in (1, -1)]
        columns.append((change[0] - change[1]) / (2.0 * step))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("fixed", ["nothing", "free_cameras", "free_bodies", "free_parts"])
def test_the_jacobian_is_that_of_finite_differences(fixed: str) -> None:
    bundle = watched_robot(times=5, **({} if fixed == "nothing" else {fixed: False}))
    expected, found = dense_jacobian(bundle), linearised(bundle).jacobian.toarray()
    size = np.linalg.norm(expected, axis=0)
    np.testing.assert_allclose(found / size, expected / size, atol=1e-7)


def test_the_minimum_and_the_covariances_are_scipys() -> None:
    """SciPy, started there, finds nothing better."""
    adjusted = adjust_bundle(watched_robot(times=5))
    bundle = adjusted.bundle
    assert adjusted.used.all()
    solved = least_squares(
        lambda x: linearised(bundle.moved(x)).residual,
        np.zeros(bundle.unknowns),
        lambda x: linearised(bundle.moved(x)).jacobian.toarray(),  # as for a step from there
        x_scale="jac",
        xtol=1e-12,
        ftol=1e-12,
    )
    assert adjusted.cost == pytest.approx(2.0 * solved.cost, rel=1e-9)
    best = bundle.moved(solved.x)
    for mine, theirs in (
        (bundle.chain.world_from_camera, best.chain.world_from_camera),
        (bundle.chain.world_from_body, best.chain.world_from_body),
        (bundle.chain.body_from_part, best.chain.body_from_part),
    ):
        np.testing.assert_allclose(se3.log(se3.inverse(theirs) @ mine), 0.0, atol=3e-7)
    jacobian = dense_jacobian(bundle)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    sigmas = np.sqrt(np.diagonal(covariance))
    for found, begin, count in (
        (adjusted.camera_covariance[6:, 6:], 0, 18),
        (adjusted.part_covariance[6:, 6:], 18, 30),
    ):
        own = slice(begin, begin + count)
        scale = np.outer(sigmas[own], sigmas[own])
        np.testing.assert_allclose(found / scale, covariance[own, own] / scale, atol=1e-5)
    np.testing.assert_array_equal(adjusted.camera_covariance[:6], 0.0)
    assert adjusted.chi2_per_dof == pytest.approx(1.0, abs=0.35)


def test_a_wrong_view_is_left_out_and_the_rest_is_as_without_it() -> None:
    bundle = watched_robot(seed=3, times=8)
    wrong = bundle.view == 5
    pixels = bundle.seen.pixels.copy()
    pixels[wrong] += [12.0, -9.0]
    spoilt = replace(bundle, seen=replace(bundle.seen, pixels=pixels))
    adjusted = adjust_bundle(spoilt)
    np.testing.assert_array_equal(adjusted.used, ~wrong)
    without = adjust_bundle(replace(bundle.only(~wrong), view=bundle.view[~wrong]))
    np.testing.assert_allclose(
        adjusted.bundle.chain.body_from_part, without.bundle.chain.body_from_part, atol=1e-8
    )
    assert adjusted.cost == pytest.approx(without.cost, rel=1e-9)


def test_corners_may_be_less_accurate_than_stated() -> None:
    """Ten times as much noise as stated: only the view that is wrong is left out."""
    bundle = watched_robot(seed=3, times=8)
    wrong = bundle.view == 5
    rng = np.random.default_rng(4)
    pixels = bundle.seen.pixels + rng.normal(0.0, 10.0 * SIGMA_PX, bundle.seen.pixels.shape)
    pixels[wrong] += [30.0, -25.0]
    adjusted = adjust_bundle(replace(bundle, seen=replace(bundle.seen, pixels=pixels)))
    np.testing.assert_array_equal(adjusted.used, ~wrong)


def test_bodies_alone_and_shared_poses_alone_are_adjusted() -> None:
    for fixed in ("cameras and parts", "bodies"):
        of_bodies = fixed == "bodies"
        bundle = watched_robot(
            free_bodies=not of_bodies, free_cameras=of_bodies, free_parts=of_bodies
        )
        adjusted = adjust_bundle(bundle)
        assert adjusted.chi2_per_dof == pytest.approx(1.0, abs=0.35)


def test_a_far_start_is_brought_home() -> None:
    """Some decimetres and 10 degrees off: the first steps are damped."""
    bundle = watched_robot(seed=4, times=10, off=0.15)
    adjusted = adjust_bundle(bundle)
    assert adjusted.used.all()
    assert adjusted.chi2_per_dof == pytest.approx(1.0, abs=0.35)


def test_what_is_not_determined_is_refused() -> None:
    bundle = replace(watched_robot(), priors=())
    unseen = bundle.seen.part != 4
    with pytest.raises(GeometryError, match="do not determine all poses"):
        adjust_bundle(bundle.only(unseen))
    # The whole may be moved about: nothing says where it is.
    floating = replace(bundle, free=np.ones_like(bundle.free))
    with pytest.raises(GeometryError, match="do not determine all poses"):
        adjust_bundle(floating)
    few = bundle.only(np.isin(np.arange(len(bundle.seen)), np.arange(8)))
    with pytest.raises(GeometryError, match="16 residuals for 90 unknowns: too little was seen"):
        adjust_bundle(few)
    behind = replace(bundle, poses=bundle.poses.copy())
    behind.chain.world_from_body[0, :3, 3] += [0.0, 0.0, 50.0]
    with pytest.raises(GeometryError, match="behind its camera or outside its lens"):
        adjust_bundle(behind)
