"""Wrong IDs put into a run of known truth are taken out again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from camera import Camera
from tests.tools.reenactment.synthetic import TrueRun, make_run
from tools.reenactment.prepare import map_positions, mend_associations


@pytest.fixture(scope="module")
def run(published_camera: Camera) -> TrueRun:
    return make_run(published_camera, 1)


def test_right_ids_are_left_alone(run: TrueRun) -> None:
    mending = mend_associations(run.graph, run.truth, gate=5.0)
    assert mending.changes == 0
    np.testing.assert_array_equal(mending.graph.disc_index, run.graph.disc_index)
    np.testing.assert_array_equal(mending.estimate.disc_xy, run.truth.disc_xy)


def test_a_row_with_its_neighbours_id_goes_back(run: TrueRun) -> None:
    disc = run.graph.disc_index.copy()
    disc[100] = (disc[100] + 5) % len(run.graph.disc_ids)
    mending = mend_associations(replace(run.graph, disc_index=disc), run.truth, gate=5.0)
    assert (mending.merged, mending.reassigned, mending.added) == (0, 1, 0)
    np.testing.assert_array_equal(mending.graph.disc_index, run.graph.disc_index)


def test_two_ids_of_one_disc_become_one(run: TrueRun) -> None:
    # In the second round disc 4 is given a new ID.
    graph, truth = run.graph, run.truth
    disc = graph.disc_index.copy()
    renamed = (disc == 4) & (graph.disc_pose > 76)
    assert 0 < renamed.sum() < (disc == 4).sum()
    disc[renamed] = len(graph.disc_ids)
    mistaken = replace(graph, disc_index=disc, disc_ids=np.append(graph.disc_ids, 999))
    twice = replace(truth, disc_xy=np.vstack([truth.disc_xy, truth.disc_xy[4] + 0.03]))
    mending = mend_associations(mistaken, twice, gate=5.0)
    assert (mending.merged, mending.reassigned, mending.added) == (1, 0, 0)
    assert len(mending.estimate.disc_xy) == len(truth.disc_xy)
    together = mending.graph.disc_index[graph.disc_index == 4]
    assert np.all(together == together[0])


def test_one_id_at_two_places_becomes_two_discs(run: TrueRun) -> None:
    # Disc 7 is taken for disc 20, which lies elsewhere; disc 7 itself is never named.
    graph = run.graph
    disc = np.where(graph.disc_index == 7, 20, graph.disc_index)
    mending = mend_associations(replace(graph, disc_index=disc), run.truth, gate=5.0)
    assert mending.added == 1
    found = mending.graph.disc_index[graph.disc_index == 7]
    assert np.all(found == found[0])
    np.testing.assert_allclose(mending.estimate.disc_xy[found[0]], run.truth.disc_xy[7], atol=0.02)
    assert mending.graph.disc_ids[found[0]] == graph.disc_ids[20]
    assert np.all(np.diff(mending.graph.disc_ids) >= 0)


def test_rows_through_the_true_camera_lie_on_their_discs(published_camera: Camera) -> None:
    run = make_run(published_camera, 2, tilt_deg=1.0, noisy=False)
    places = map_positions(run.graph, run.truth, np.arange(len(run.graph.disc_pose)))
    np.testing.assert_allclose(places, run.truth.disc_xy[run.graph.disc_index], atol=1e-5)
