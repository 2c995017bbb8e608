"""Noise added to a run: its covariance, the rows that say so, and bytes that stay."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.landmarks import (
    CircleLandmark,
    Frame,
    LineLandmark,
    Row,
    Step,
    read_frames,
    read_rows,
)
from redetect.slam.cli import main
from redetect.slam.errors import SlamError
from redetect.slam.noise import noisy_rows
from redetect.slam.recording import ASSUMED, recording_of_frames
from redetect.slam.settings import AddedNoise

STEP = Step("a.0", 0.01, -0.2, 0.05, 2e-5, 1e-7, 3e-5, 4e-5, 5e-8, 3e-4)
DISC = CircleLandmark(0.5, -2.0, 0.9, 0.002, 0.0003, 0.003, (7,))
LINE = LineLandmark(0.1, -0.5, 0.12, 0.3, 3.14, 0.01, 0.0, 0.002, (4, 5))
NOISE = AddedNoise(sigma=0.03, bearing_sigma=0.01, step_sigma=0.005, turn_sigma=0.02, seed=3)


def _added(count: int) -> list[Row]:
    rows = [Row(record) for _ in range(count) for record in (STEP, DISC, LINE)]
    return list(noisy_rows(rows, NOISE))[1:]


def test_added_noise_has_the_stated_covariance() -> None:
    count = 20_000
    rows = [row.record for row in _added(count)]
    steps = np.array([(r.dx, r.dy, r.dphi) for r in rows if isinstance(r, Step)])
    discs = np.array([(r.px, r.py) for r in rows if isinstance(r, CircleLandmark)])
    bearings = np.array([r.alpha for r in rows if isinstance(r, LineLandmark)])
    error = np.concatenate(
        [
            (steps - [STEP.dx, STEP.dy, STEP.dphi]) / [0.005, 0.005, 0.02],
            (discs - [DISC.px, DISC.py]) / 0.03,
            ((bearings - LINE.alpha + math.pi) % (2 * math.pi) - math.pi)[:, None] / 0.01,
        ],
        axis=1,
    )
    # Four standard deviations of a sample covariance of independent normal numbers.
    assert np.abs(error.mean(axis=0)).max() < 4 / math.sqrt(count)
    assert np.abs(np.cov(error.T) - np.eye(6)).max() < 4 * math.sqrt(2 / count)
    assert np.all(np.abs(bearings) <= math.pi)  # 3.14 and noise goes round


def test_covariances_are_the_sum_of_both_and_the_rest_stays() -> None:
    step, disc, line = (row.record for row in _added(1))
    assert isinstance(step, Step)
    assert isinstance(disc, CircleLandmark)
    assert isinstance(line, LineLandmark)
    assert (step.cxx, step.cyy) == pytest.approx((2e-5 + 0.005**2, 3e-5 + 0.005**2))
    assert step.cphiphi == pytest.approx(3e-4 + 0.02**2)
    assert (step.cxy, step.cxphi, step.cyphi) == (STEP.cxy, STEP.cxphi, STEP.cyphi)
    assert (disc.cxx, disc.cyy) == pytest.approx((0.002 + 0.03**2, 0.003 + 0.03**2))
    assert (disc.cxy, disc.quality, disc.ids) == (DISC.cxy, DISC.quality, DISC.ids)
    assert line.sigma == pytest.approx(math.sqrt(0.002**2 + 0.01**2))
    assert (line.xtop, line.ytop, line.xbottom, line.ybottom) == (0.1, -0.5, 0.12, 0.3)
    assert (line.beta, line.quality, line.ids) == (LINE.beta, LINE.quality, LINE.ids)


@pytest.mark.parametrize("noise", [AddedNoise(turn_sigma=0.05), AddedNoise(step_sigma=1e-4)])
def test_noise_of_a_step_without_covariance_is_added_to_the_assumed_one(noise: AddedNoise) -> None:
    _, row = noisy_rows([Row(Step("a.0", 0.0, -2.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))], noise)
    step = row.record
    assert isinstance(step, Step)
    assumed = ASSUMED.covariance(np.array([[0.0, -2.0, 0.1]]))[0]
    added = np.diag(np.square([noise.step_sigma, noise.step_sigma, noise.turn_sigma]))
    (found,) = recording_of_frames([Frame(step)], "run").step_covariance
    np.testing.assert_allclose(found, assumed + added)


def test_normalised_error_of_the_noisy_rows_is_one_where_it_was_one() -> None:
    """Discs that had an error of their covariance have one of their new covariance after."""
    rng = np.random.default_rng(2)
    covariance = np.array([[0.002, 0.0003], [0.0003, 0.003]])
    places = rng.multivariate_normal([0.5, -2.0], covariance, 5000)
    rows = [Row(CircleLandmark(x, y, 0.9, 0.002, 0.0003, 0.003, (1,))) for x, y in places]
    squared = []
    for row in list(noisy_rows(rows, NOISE))[1:]:
        disc = row.record
        assert isinstance(disc, CircleLandmark)
        spread = np.array([[disc.cxx, disc.cxy], [disc.cxy, disc.cyy]])
        off = np.array([disc.px - 0.5, disc.py + 2.0])
        squared.append(off @ np.linalg.solve(spread, off))
    assert np.mean(squared) == pytest.approx(2.0, abs=4 * math.sqrt(4 / 5000))


def test_files_of_discs_and_lines_get_the_same_odometry() -> None:
    discs = [Row(STEP), Row(DISC), Row(DISC), Row(STEP)]
    lines = [Row(STEP), Row(LINE), Row(STEP)]
    first, second = (
        [row.record for row in noisy_rows(rows, NOISE) if isinstance(row.record, Step)]
        for rows in (discs, lines)
    )
    assert first == second


@given(values=st.tuples(*[st.floats(0.0, 10.0) for _ in range(4)]), seed=st.integers(0, 2**31 - 1))
def test_same_seed_same_rows_and_every_row_can_be_read_back(
    values: tuple[float, float, float, float], seed: int
) -> None:
    noise = AddedNoise(*values, seed)
    rows = [Row(STEP), Row(DISC), Row(LINE)]
    one = list(noisy_rows(rows, noise))
    assert one == list(noisy_rows(rows, noise))
    assert len(one) == 3 + (not noise.nothing)


@pytest.mark.parametrize("bad", [-1e-9, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["sigma", "bearing_sigma", "step_sigma", "turn_sigma"])
def test_a_sigma_that_is_none_is_refused(name: str, bad: float) -> None:
    with pytest.raises(SlamError, match=name):
        replace(AddedNoise(), **{name: bad})  # type: ignore[arg-type]


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(SlamError, match="seed"):
        AddedNoise(seed=-1)


@pytest.mark.parametrize("suffix", [".circles", ".lines"])
def test_command_without_noise_gives_the_same_bytes(
    project_root: Path, tmp_path: Path, suffix: str
) -> None:
    source = project_root / "images" / "e" / f"map{suffix}"
    target = tmp_path / f"same{suffix}"
    assert main(["noise", str(source), "-o", str(target)]) == 0
    assert target.read_bytes() == source.read_bytes()


def test_command_keeps_comments_ids_and_line_ends(tmp_path: Path) -> None:
    source = tmp_path / "map.circles"
    source.write_bytes(
        b"# head\r\n \r\n"
        b"STEP a.0  0.01000 -0.20000  0.05000 0.00002 0 0.00003 0 0 0.0003\r\n"
        b"LANDMARK_C 0.5 -2 0.9 0.002 0.0001 0.003 7 8\r\n# between\r\n"
        b"LANDMARK_C 0.6 -2 0.9 0.002 0.0001 0.003\r\n"
    )
    arguments = ["noise", str(source), "--sigma", "0.05", "--step-sigma", "0.001"]
    target = tmp_path / "out.circles"
    assert main([*arguments, "-o", str(target)]) == 0
    lines = target.read_bytes().splitlines(keepends=True)
    assert all(line.endswith(b"\r\n") for line in lines)
    assert lines[0].startswith(b"# Noise was added")
    assert b"0.05 m" in lines[0]
    assert lines[1:3] == [b"# head\r\n", b" \r\n"]
    assert lines[5] == b"# between\r\n"
    (frame,) = read_frames(target)
    assert [disc.ids for disc in frame.circles] == [(7, 8), ()]
    assert frame.circles[0].cxx == pytest.approx(0.0045)
    assert frame.step.cxx == pytest.approx(0.000021)
    assert frame.circles[0].px != 0.5
    again = tmp_path / "again.circles"
    assert main([*arguments, "-o", str(again)]) == 0
    assert again.read_bytes() == target.read_bytes()
    other = tmp_path / "other.circles"
    assert main([*arguments, "--seed", "2", "-o", str(other)]) == 0
    assert other.read_bytes() != target.read_bytes()
    assert [row.line for row in read_rows(source)] == [1, 2, 3, 4, 5, 6]


def test_a_byte_order_mark_does_not_come_after_the_comment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, target = tmp_path / "map.circles", tmp_path / "out.circles"
    source.write_bytes(b"\xef\xbb\xbfSTEP a.0 0.01 -0.2 0.05 2e-5 0 3e-5 0 0 3e-4\n")
    assert main(["noise", str(source), "--sigma", "0.05", "-o", str(target), "-q"]) == 0
    assert "".join(capsys.readouterr()) == ""
    assert [frame.step for frame in read_frames(target)] == [
        frame.step for frame in read_frames(source)
    ]


def test_command_refuses_to_overwrite_and_negative_noise(
    project_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "kept.circles"
    target.write_bytes(b"mine")
    run = str(project_root / "images" / "e")
    assert main(["noise", run, "--sigma", "0.1", "-o", str(target)]) == 1
    assert target.read_bytes() == b"mine"
    with pytest.raises(SystemExit, match="2"):
        main(["noise", run, "--sigma=-0.1", "-o", str(target), "--force"])
    assert "sigma is -0.1" in capsys.readouterr().err
    assert target.read_bytes() == b"mine"
