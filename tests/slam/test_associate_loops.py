"""The parts of closing a loop: motions between constellations, chance, labels, paths."""

from __future__ import annotations

import math
import tracemalloc
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.array_types import FloatArray, IntArray
from redetect.plane import apply, between, chain_steps, fitted, rotation
from redetect.slam.association.loop_closing import (
    closed_path,
    in_order,
    intersect_bearings,
    merge_labels,
    pairs_by_position,
    pairs_by_votes,
    solve_path,
)
from redetect.slam.association.loops import (
    REACH_M,
    Match,
    Search,
    Submap,
    chance_of_agreeing,
    find_matches,
    log10_false_alarms,
    motion_onto,
    mutual_pairs,
    submaps_of,
)
from redetect.slam.models import bearing_of_vertical, disc_in_robot
from redetect.slam.recording import CircleRows, LineRows, Recording
from tests.slam.ekf_rows import circle_rows


@given(
    seed=st.integers(0, 2**32 - 1),
    turn=st.floats(-3.1, 3.1),
    x=st.floats(-20.0, 20.0),
    y=st.floats(-20.0, 20.0),
)
def test_motion_of_least_squares_is_the_motion_that_was_made(
    seed: int, turn: float, x: float, y: float
) -> None:
    points = np.random.default_rng(seed).uniform(-3.0, 3.0, (6, 2))
    moved = points @ rotation(turn).T + [x, y]
    found = fitted(points, moved)
    assert np.exp(1j * found[2]) == pytest.approx(np.exp(1j * turn), abs=1e-9)
    assert apply(found, points) == pytest.approx(moved, abs=1e-9)


@given(seed=st.integers(0, 2**32 - 1), turn=st.floats(-3.1, 3.1))
def test_search_finds_the_motion_among_landmarks_that_the_other_has_not(
    seed: int, turn: float
) -> None:
    rng = np.random.default_rng(seed)
    place = rng.uniform(0.0, 6.0, (22, 2))
    common = 14
    fixed = place + rng.normal(0.0, 0.02, place.shape)
    other = rng.uniform(0.0, 6.0, (6, 2))
    moved = np.concatenate([place[:common], other]) @ rotation(turn).T + [3.0, -4.0]
    pose, agreeing, tried = motion_onto(moved, fixed, Search(np.pi, np.inf, 6))
    assert tried > 0
    assert agreeing >= 12
    assert np.cos(pose[2] + turn) > np.cos(0.05)
    back = apply(pose, moved)
    assert np.linalg.norm(back[:common] - place[:common], axis=1).mean() < 0.15
    gap = np.linalg.norm(back[:, None] - fixed[None], axis=2).min(axis=1)
    near = gap[gap <= 0.12]
    assert agreeing == pytest.approx(len(near), abs=1)  # looked up by cells of 0.05 m


def test_search_keeps_to_its_limits() -> None:
    place = np.random.default_rng(1).uniform(0.0, 6.0, (15, 2))
    turned = place @ rotation(0.5).T
    assert motion_onto(turned, place, Search(0.6, 10.0, 6)).agreeing == 15
    assert motion_onto(turned, place, Search(0.4, 10.0, 6)).agreeing == 0
    assert motion_onto(place + 5.0, place, Search(0.6, 3.0, 6)).agreeing == 0
    assert motion_onto(place[:0], place, Search(0.6, 3.0, 6)).agreeing == 0


def test_number_of_false_alarms_is_the_binomial_tail_times_the_motions_tried() -> None:
    rng = np.random.default_rng(2)
    agreeing = np.sum(rng.random((200_000, 10)) < 0.2, axis=1)
    share = np.mean(agreeing >= 5)
    expected = 1000 * share
    found = 10 ** log10_false_alarms(7, 12, 0.2, 1000)
    assert found == pytest.approx(expected, rel=5 / np.sqrt(200_000 * share))
    assert log10_false_alarms(2, 12, 0.2, 1000) == pytest.approx(3.0)


def _submap(frame: int, labels: range, xy: FloatArray) -> Submap:
    return Submap(frame, np.array(labels, dtype=np.int64), xy)


@pytest.mark.long
def test_random_constellations_do_not_match_and_one_place_seen_twice_does() -> None:
    rng = np.random.default_rng(3)
    submaps = [
        _submap(100 * k, range(20 * k, 20 * k + 20), rng.uniform(0, 5, (20, 2))) for k in range(30)
    ]
    assert find_matches(submaps, Search()) == []
    place = submaps[4].xy[:14]
    again = np.concatenate([place + rng.normal(0, 0.02, place.shape), rng.uniform(0, 5, (6, 2))])
    again = again @ rotation(0.3).T + [1.0, 2.0]
    submaps.append(_submap(3000, range(600, 620), again))
    (match,) = find_matches(submaps, Search())
    assert (match.earlier_frame, match.later_frame) == (400, 3000)
    right = [(80 + k, 600 + k) for k in range(14)]
    assert set(map(tuple, match.pairs.tolist())) >= set(right[2:4])
    assert len(set(map(tuple, match.pairs.tolist())) & set(right)) >= 12
    assert match.motion[2] == pytest.approx(-0.3, abs=0.03)
    assert match.log10_false_alarms < -3


def test_an_area_of_a_park_costs_no_more_than_that_of_a_room() -> None:
    """Landmarks may be hundreds of metres apart."""
    rng = np.random.default_rng(6)
    fixed = rng.uniform(0, 400, (3000, 2))
    near = fixed[np.argsort(np.hypot(*(fixed - 200.0).T))[:20]]
    moved = (near + rng.normal(0, 0.02, (20, 2)) - [3.0, 2.0]) @ rotation(0.2)
    alike = motion_onto(moved[:2], fixed, Search(most_shift_m=math.inf))  # compiles
    assert alike.agreeing == 0
    tracemalloc.start()
    try:
        motion = motion_onto(moved, fixed, Search(most_shift_m=math.inf))
        chance = chance_of_agreeing(fixed)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert motion.agreeing >= 18
    assert motion.pose == pytest.approx([3.0, 2.0, 0.2], abs=0.1)
    assert chance == pytest.approx((REACH_M / 0.6) ** 2, rel=0.05)  # of landmarks far apart
    assert most < 30e6


def test_submaps_that_share_landmarks_already_are_not_matched() -> None:
    rng = np.random.default_rng(4)
    xy = rng.uniform(0, 5, (20, 2))
    shared = np.r_[0:3, 20:37]
    submaps = [_submap(0, range(20), xy), Submap(500, shared, xy)]
    assert find_matches(submaps, Search()) == []
    apart = [_submap(0, range(20), xy), _submap(500, range(20, 40), xy)]
    assert len(find_matches(apart, Search())) == 1
    close = [_submap(0, range(20), xy), _submap(30, range(20, 40), xy)]
    assert find_matches(close, Search()) == []


def test_submaps_hold_what_their_frames_saw() -> None:
    frames = np.repeat(np.arange(100), 2)
    labels = np.repeat(np.arange(100), 2) // 5
    xy = np.stack([np.arange(20.0), np.zeros(20)], axis=1)
    xy[3] = np.nan
    found = submaps_of(frames, labels, xy, 100)
    assert found[0].labels.tolist() == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    assert [s.middle_frame for s in found[:3]] == [25, 35, 45]
    assert found[0].xy[3].tolist() == [4.0, 0.0]


def test_submaps_that_are_compared_hold_what_was_seen_most() -> None:
    labels = np.array([0, 1, 2, 2, 3, 4, 4, 4, 1])
    xy = np.stack([np.arange(5.0), np.zeros(5)], axis=1)
    (found,) = submaps_of(np.arange(9), labels, xy, 9, least=1, most=3)
    assert found.labels.tolist() == [1, 2, 4]
    assert found.xy[:, 0].tolist() == [1.0, 2.0, 4.0]


def test_labels_with_few_rows_are_not_compared_where_they_are_many() -> None:
    def compared(rows: list[int]) -> list[int]:
        labels = np.repeat(np.arange(len(rows)), rows)
        xy = np.stack([np.arange(float(len(rows))), np.zeros(len(rows))], axis=1)
        (found,) = submaps_of(np.zeros(len(labels), np.int64), labels, xy, 9, least=1, most=80)
        return [int(label) for label in found.labels]

    assert compared([20, 1, 30, 2, 25, 1, 1, 1, 1, 5]) == [0, 2, 4, 9]
    assert compared([20, 1, 30, 25, 8, 1, 5]) == list(range(7))
    assert compared([2, 1, 3, 1, 1, 1, 1]) == list(range(7))  # a fast robot


@given(
    rows=st.lists(st.tuples(st.integers(0, 6), st.integers(0, 7)), min_size=1, max_size=25),
    pairs=st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7)), max_size=12),
)
def test_merging_never_joins_what_was_seen_together_and_never_splits(
    rows: list[tuple[int, int]], pairs: list[tuple[int, int]]
) -> None:
    rows = sorted(set(rows))
    frames = np.array([frame for frame, _ in rows], dtype=np.int64)
    labels = in_order(np.array([label for _, label in rows], dtype=np.int64))
    count = int(labels.max()) + 1
    usable = [(a, b) for a, b in pairs if a < count and b < count and a != b]
    merged, fewer = merge_labels(frames, labels, usable)
    assert len(set(merged.tolist())) == count - fewer
    assert len(set(zip(frames.tolist(), merged.tolist()))) == len(rows)  # still apart in a frame
    for label in range(count):
        assert len(set(merged[labels == label].tolist())) == 1
    together = [(labels[i], labels[j]) for i, j in permutations(range(len(rows)), 2)
                if frames[i] == frames[j]]  # fmt: skip
    groups = {label: int(merged[labels == label][0]) for label in range(count)}
    assert all(groups[a] != groups[b] for a, b in together)
    if usable and (min(usable[0]), max(usable[0])) not in together:
        assert groups[usable[0][0]] == groups[usable[0][1]]


def test_labels_that_clutter_keeps_apart_in_a_tenth_of_their_frames_are_merged() -> None:
    frames = np.r_[0:10, 9:29]
    labels = np.repeat([0, 1], [10, 20])
    assert merge_labels(frames, labels, [(0, 1)])[1] == 0
    assert merge_labels(frames, labels, [(0, 1)], 0.1)[1] == 1
    assert merge_labels(np.r_[0:10, 8:28], labels, [(0, 1)], 0.1)[1] == 0


def test_pairs_are_in_the_order_of_their_votes() -> None:
    matches = map(np.array, ([[1, 5], [2, 6]], [[6, 2], [3, 7]], [[2, 6]]))
    assert pairs_by_votes(matches) == [(2, 6), (1, 5), (3, 7)]


def test_labels_at_one_spot_are_paired_only_in_submaps_known_to_be_one_place() -> None:
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    spread = np.tile(0.01**2 * np.eye(2), (10, 1, 1))
    known = [Submap(0, np.array([0, 1, 2, 3]), xy), Submap(90, np.array([0, 1, 2, 9]), xy + 0.01)]
    assert pairs_by_position(known, spread) == [(3, 9)]
    assert pairs_by_position(known, 0.01 * spread) == []
    strangers = [known[0], Submap(90, np.array([6, 7, 2, 9]), xy)]
    assert pairs_by_position(strangers, spread) == []
    assert pairs_by_position(known[:0], spread) == []


def test_labels_of_one_stretch_are_paired_by_their_covariances() -> None:
    """The nearest need not be the likeliest: positions are uncertain along the line of sight."""
    xy = np.array([[0.0, 0.0], [0.0, 0.2], [0.1, 0.0]])
    spread = np.tile(np.diag([0.01**2, 0.1**2]), (3, 1, 1))
    assert pairs_by_position([Submap(0, np.arange(3), xy)], spread) == [(0, 1)]


def test_mutual_pairs_are_each_others_nearest() -> None:
    first = np.array([[0.0, 0.0], [0.1, 0.0], [5.0, 5.0]])
    second = np.array([[0.08, 0.0], [9.0, 9.0]])
    assert mutual_pairs(first, second, 0.2).tolist() == [[1, 0]]
    assert mutual_pairs(first, second, 0.01).tolist() == []
    assert mutual_pairs(first[:0], second, 0.2).shape == (0, 2)


def test_a_path_bent_by_far_is_closed_by_matches() -> None:
    """A circle driven twice with a heading bias that turns the second lap by 1.9 rad."""
    steps = np.tile([0.0, -0.2, 2 * np.pi / 120], (240, 1))
    bent = chain_steps(steps + np.array([0.0, 0.0, 0.008]))
    # The same place after one lap: what brings frame 120 of the bent path where frame 0 is.
    matches = []
    for frame in (0, 60, 119):
        turn = bent[frame + 1, 2] + 2 * np.pi - bent[frame + 121, 2]
        shift = bent[frame + 1, :2] - rotation(turn) @ bent[frame + 121, :2]
        matches.append(
            Match(frame, frame + 120, np.zeros((0, 2), dtype=np.int64), np.append(shift, turn), -9)
        )
    closed = closed_path(bent, matches, np.zeros(0, np.int64))
    off = [np.linalg.norm(p[121:, :2] - p[1:121, :2], axis=1).max() for p in (bent, closed)]
    assert off[0] > 2.0
    assert off[1] < 0.3  # a start for least squares: matches and steps each give way a little
    assert closed[0] == pytest.approx(bent[0])


def _seen_exactly(seed: int) -> tuple[Recording, FloatArray, FloatArray, IntArray, FloatArray]:
    rng = np.random.default_rng(seed)
    steps = np.tile([0.02, -0.2, 0.05], (30, 1))
    path = chain_steps(steps)
    discs, lines = rng.uniform(-6, 2, (12, 2)), rng.uniform(-9, 3, (6, 2))
    frame = np.repeat(np.arange(30), 3)
    label = in_order(rng.integers(0, 12, 90))
    which = np.array([label[0]])
    which = rng.permutation(12)[label]
    upright = np.tile(np.arange(6), 30)
    line_frame = np.repeat(np.arange(30), 6)
    bearing = bearing_of_vertical(path[line_frame + 1], lines[upright], (0.02, -0.08))
    recording = Recording(
        tuple(map(str, range(30))),
        between(path[:-1], path[1:]),
        np.tile(1e-4 * np.eye(3), (30, 1, 1)),
        CircleRows(
            frame,
            disc_in_robot(path[frame + 1], discs[which]),
            np.tile(1e-3 * np.eye(2), (90, 1, 1)),
            which.astype(np.int64),
        ),
        LineRows(line_frame, bearing, np.full(180, 0.002), tuple((int(i),) for i in upright)),
    )
    places = np.full((int(label.max()) + 1, 2), np.nan)
    places[label] = discs[which]
    return recording, path, places, label, lines


def test_least_squares_finds_the_truth_from_a_wrong_start() -> None:
    recording, path, places, label, lines = _seen_exactly(5)
    upright = np.array([ids[0] for ids in recording.lines.ids])
    start = path + np.random.default_rng(6).normal(0.0, 0.03, path.shape)
    start[0] = path[0]
    found = solve_path(recording, label, upright, start, lines + 0.05, camera_xy=(0.02, -0.08))
    # The lines' start pulls a little: by 0.05 m with 3 m of standard deviation.
    assert found.path == pytest.approx(path, abs=2e-3)
    assert found.circle_xy == pytest.approx(places, abs=2e-3)
    alone = solve_path(recording, label, upright, start)
    assert alone.path == pytest.approx(path, abs=1e-5)
    assert np.all(np.isnan(alone.line_xy))


def test_bearings_intersect_where_the_line_stands() -> None:
    # Lines to both sides of a straight way, in view of the half plane ahead for part of it only.
    path = chain_steps(np.tile([0.0, -0.2, 0.0], (20, 1)))
    lines = np.array([[1.5, -6.0], [-1.2, -5.0], [0.0, -300.0]])
    frame, label = np.repeat(np.arange(20), 3), np.tile(np.arange(3), 20)
    bearing = bearing_of_vertical(path[frame + 1], lines[label], (0.02, -0.08))
    recording = Recording(
        tuple(map(str, range(20))),
        between(path[:-1], path[1:]),
        np.tile(np.eye(3), (20, 1, 1)),
        circle_rows(),
        LineRows(frame, bearing, np.full(60, 0.002), tuple((int(i),) for i in label)),
    )
    found = intersect_bearings(recording, path, label, camera_xy=(0.02, -0.08))
    assert found[:2] == pytest.approx(lines[:2], abs=1e-6)
    assert np.all(np.isnan(found[2]))  # too far for 4 m of way to say where
