"""Wrong IDs put into a run of known truth are taken out again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from camera import Camera
from tests.tools.reenactment.synthetic import make_run
from tools.reenactment.associations import map_positions, mend_associations
from tools.reenactment.mounted_discs import Geometry
from tools.reenactment.recording import Recording, recording_of_frames


@pytest.fixture
def recording(published_camera: Camera) -> Recording:
    return recording_of_frames(published_camera, make_run(published_camera, 1).frames)


@pytest.fixture
def geometry(published_camera: Camera) -> Geometry:
    return make_run(published_camera, 1).geometry


def test_right_ids_are_left_alone(
    published_camera: Camera, recording: Recording, geometry: Geometry
) -> None:
    mending = mend_associations(published_camera, recording, geometry, gate=5.0)
    assert mending.changes == 0
    np.testing.assert_array_equal(mending.recording.disc, recording.disc)
    np.testing.assert_array_equal(mending.geometry.disc_xy, geometry.disc_xy)


def test_a_row_with_its_neighbours_id_goes_back(
    published_camera: Camera, recording: Recording, geometry: Geometry
) -> None:
    row = 100
    disc = recording.disc.copy()
    disc[row] = (disc[row] + 5) % len(recording.disc_ids)
    mending = mend_associations(published_camera, replace(recording, disc=disc), geometry, gate=5.0)
    assert (mending.merged, mending.reassigned, mending.added) == (0, 1, 0)
    np.testing.assert_array_equal(mending.recording.disc, recording.disc)


def test_two_ids_of_one_disc_become_one(
    published_camera: Camera, recording: Recording, geometry: Geometry
) -> None:
    # In the second round disc 4 is given a new ID.
    disc = recording.disc.copy()
    renamed = (disc == 4) & (recording.frame > 75)
    assert 0 < renamed.sum() < (disc == 4).sum()
    disc[renamed] = len(recording.disc_ids)
    mistaken = replace(recording, disc=disc, disc_ids=np.append(recording.disc_ids, 999))
    twice = replace(geometry, disc_xy=np.vstack([geometry.disc_xy, geometry.disc_xy[4] + 0.03]))
    mending = mend_associations(published_camera, mistaken, twice, gate=5.0)
    assert (mending.merged, mending.reassigned, mending.added) == (1, 0, 0)
    assert len(mending.geometry.disc_xy) == len(geometry.disc_xy)
    together = mending.recording.disc[recording.disc == 4]
    assert np.all(together == together[0])


def test_one_id_at_two_places_becomes_two_discs(
    published_camera: Camera, recording: Recording, geometry: Geometry
) -> None:
    # Disc 7 is taken for disc 20, which lies elsewhere; disc 7 itself is never named.
    disc = np.where(recording.disc == 7, 20, recording.disc)
    mending = mend_associations(published_camera, replace(recording, disc=disc), geometry, gate=5.0)
    assert mending.added == 1
    found = mending.recording.disc[recording.disc == 7]
    assert np.all(found == found[0])
    np.testing.assert_allclose(mending.geometry.disc_xy[found[0]], geometry.disc_xy[7], atol=0.02)
    assert mending.recording.disc_ids[found[0]] == recording.disc_ids[20]
    assert np.all(np.diff(mending.recording.disc_ids) >= 0)


def test_rows_through_the_true_camera_lie_on_their_discs(published_camera: Camera) -> None:
    run = make_run(published_camera, 2, tilt_deg=1.0, noisy=False)
    recording = recording_of_frames(published_camera, run.frames)
    rows = np.arange(len(recording.frame))
    places = map_positions(published_camera, recording, run.geometry, rows)
    np.testing.assert_allclose(places, run.geometry.disc_xy[recording.disc], atol=1e-5)
