"""The evaluation of markers counts and measures what it says it does."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tools.evaluation.__main__ import main
from tools.evaluation.markers import (
    DECODING,
    GIVEN_WIDTH,
    SEARCH,
    offences,
    score_frames,
    search_photographs,
    time_searches,
)
from tools.evaluation.markers_statistics import (
    BINS,
    COLUMNS,
    FOUND,
    MISIDENTIFIED,
    MISSED,
    OURS,
    PEERS,
    Found,
    Outcome,
    ScoredFrame,
    bins_of,
    counts_lines,
    known_to_opencv,
    print_bins,
    score_frame,
    search,
    table_of,
)
from tools.simulator.markers.samples import SampleSettings, sample_frame
from tools.simulator.markers.truth import MarkerTruth

SQUARE = np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0]])


def _marker(number: int, corners: np.ndarray) -> MarkerTruth:
    return MarkerTruth("4x4_50", number, corners, np.eye(4), 0.2, 40.0, 10.0, 100.0, 1.0, 1.0)


def test_every_kind_of_detection_is_told_apart() -> None:
    markers = [_marker(k, SQUARE + np.array([60.0 * k, 0.0])) for k in range(4)]
    found = Found(
        np.array([0, 7, 2, 9, 0]),
        np.stack(
            [
                markers[0].corners + np.array([0.3, -0.4]),  # right
                markers[1].corners,  # another number
                np.roll(markers[2].corners, 1, axis=0),  # turned
                SQUARE + 500.0,  # nothing there
                markers[0].corners + 1.0,  # once more
            ]
        ),
        np.tile(0.25 * np.eye(2), (5, 4, 1, 1)),
    )
    outcome = score_frame(markers, found)
    assert outcome.status.tolist() == [FOUND, MISIDENTIFIED, MISIDENTIFIED, MISSED]
    np.testing.assert_allclose(outcome.errors_px[0], np.tile([0.3, -0.4], (4, 1)))
    assert np.isnan(outcome.errors_px[1:]).all()
    np.testing.assert_allclose(outcome.normalised[0], 0.25 / 0.25 / 2.0)
    assert outcome.false == (9,)
    assert outcome.repeated == 1


def test_a_cell_inside_a_marker_is_not_the_marker() -> None:
    inside = Found(np.array([0]), 0.3 * SQUARE[None] + 10.0)
    outcome = score_frame([_marker(0, SQUARE)], inside)
    assert outcome.status.tolist() == [MISSED]
    assert outcome.false == (0,)


def _scored(
    widths: np.ndarray, errors: dict[str, float], found: dict[str, np.ndarray]
) -> list[ScoredFrame]:
    """One frame with markers of given widths, each detector off by a given distance."""
    rows = np.column_stack(
        [widths, *(np.full(len(widths), x) for x in (10.0, 1.0, 90.0, 2.0, 0.0)),
         np.ones(len(widths))]
    )  # fmt: skip
    assert rows.shape[1] == len(COLUMNS)
    outcomes = {}
    for name, error in errors.items():
        status = np.where(found[name], FOUND, MISSED)
        off = np.where(found[name][:, None, None], [error, 0.0], np.nan) * np.ones((1, 4, 1))
        outcomes[name] = Outcome(status, off, off[..., 0] ** 2, (), 0)
    return [ScoredFrame(1, 0, "4x4_50", rows, outcomes)]


def test_bins_compare_like_with_like(capsys: pytest.CaptureFixture[str]) -> None:
    widths = np.concatenate([np.full(10, 30.0), np.full(10, 150.0)])
    every = np.ones(20, bool)
    large = widths > 100.0
    table = table_of(_scored(widths, {OURS: 0.1, "aruco": 0.3}, {OURS: every, "aruco": large}))
    figures = print_bins(table, bins_of(table))
    assert "BEHIND a peer in error or rate: nowhere" in capsys.readouterr().out
    assert figures["all"][OURS]["found"] == 1.0
    assert figures["all"]["aruco"]["found"] == 0.5
    assert figures["all"][OURS]["median"] == pytest.approx(0.1)
    both = figures["all"]["aruco"]["both: ours"], figures["all"]["aruco"]["peer"]
    assert both == pytest.approx((0.1, 0.3))
    assert figures["width / px 28-40"]["aruco"]["found"] == 0.0
    assert figures["width / px 130-200"]["aruco"]["markers"] == 10
    behind = table_of(_scored(widths, {OURS: 0.4, "aruco": 0.3}, {OURS: large, "aruco": every}))
    figures = print_bins(behind, bins_of(behind))
    assert figures["all"]["aruco"]["found"] == 1.0
    assert "BEHIND a peer in error or rate: all" in capsys.readouterr().out


def test_every_marker_is_in_one_bin_of_each_quantity() -> None:
    frames = score_frames(SampleSettings(samples=4), (OURS,), frames=2, seed=2)
    table = table_of(frames)
    bins = bins_of(table)
    clear = table.columns["clear"] > 0.0
    for quantity, (title, limits) in BINS.items():
        values = table.columns[quantity][clear]
        inside = np.count_nonzero((values >= limits[0]) & (values <= limits[-1]))
        assert sum(b.sum() for name, b in bins.items() if name.startswith(title)) == inside
    assert counts_lines(table)[0].startswith("2 frames")


def test_opencv_is_measured_as_it_is() -> None:
    settings = SampleSettings(
        dictionaries=("4x4_50",), empty=0.0, contrast_grey=(120.0, 200.0), blur_px=(0.5, 1.0),
        width_px=(60.0, 100.0), motion=0.0, occluded=0.0, cut=0.0, slant_deg=(0.0, 40.0),
    )  # fmt: skip
    table = table_of(score_frames(settings, PEERS, frames=6, seed=3))
    offsets = {}
    for name in PEERS:
        found = table.outcomes[name].status == FOUND
        assert found.mean() > 0.7
        offsets[name] = np.median(table.outcomes[name].errors_px[found], axis=(0, 1))
    # The AprilTag code's zero is half a pixel off.
    np.testing.assert_allclose(offsets["aruco apriltag"], 0.5, atol=0.15)
    np.testing.assert_allclose(offsets["apriltag - 0.5"], 0.0, atol=0.15)
    np.testing.assert_allclose(offsets["aruco subpix"], 0.0, atol=0.15)
    assert known_to_opencv("4x4_50")
    assert not known_to_opencv("rawseeds")
    with pytest.raises(ValueError, match="no such detector"):
        search("another", np.zeros((8, 8), np.uint8), None, "4x4_50")


def test_offences_name_the_frame() -> None:
    outcome = Outcome(
        np.array([MISIDENTIFIED]), np.full((1, 4, 2), np.nan), np.full((1, 4), np.nan), (5,), 0
    )
    frame = ScoredFrame(3, 17, "rawseeds", np.ones((1, 7)), {OURS: outcome})
    places = offences([frame])
    assert len(places) == 2
    assert all("seed 3 frame 17 rawseeds" in place for place in places)


def test_photographs_are_searched(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    settings = SampleSettings(
        dictionaries=("4x4_50",), markers=(1, 1), empty=0.0, things=(0, 0), cameras="pinhole",
        contrast_grey=(150.0, 150.0), blur_px=(0.6, 0.7), width_px=(80.0, 100.0), uneven=0.0,
        occluded=0.0, cut=0.0, motion=0.0, slant_deg=(0.0, 20.0),
    )  # fmt: skip
    frame = sample_frame(settings, 1, 0)
    cv2.imwrite(str(tmp_path / "sub" / "with.png"), frame.image)
    cv2.imwrite(str(tmp_path / "without.png"), np.full((120, 160), 90, np.uint8))
    count, found = search_photographs([tmp_path], "aruco", ("4x4_50",))
    assert count == 2
    assert found == [f"aruco: false: with.png 4x4_50 id {frame.markers[0].id}"]
    with pytest.raises(ValueError, match="holds no photographs"):
        search_photographs([tmp_path / "none"], "aruco", ("4x4_50",))


@pytest.mark.long
def test_searches_are_timed_beside_decoding() -> None:
    settings = SampleSettings(dictionaries=("4x4_50",), samples=2)
    times = time_searches(settings, 2, 1, rounds=3)
    assert {DECODING, SEARCH, GIVEN_WIDTH, "aruco", "aruco apriltag"} <= set(times)
    assert [times[DECODING][of] for of in ("decodings", "lower", "upper")] == [1.0, 1.0, 1.0]


@pytest.mark.long
def test_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["markers", "--statistics", "2", "--no-spot", "--frames", "2",
                 "--dictionary", "4x4_50"]  # fmt: skip
    assert main(arguments) in (0, 1)
    out = capsys.readouterr().out
    assert "clearly in view" in out
    assert "Search of 2 frames" in out
