"""g2o graphs: the same numbers after the round trip, the same error, and refusals by line."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from redetect.array_types import FloatArray
from redetect.landmarks import CircleLandmark, Frame, Step, wrap_angle
from redetect.plane import between, rotation
from redetect.slam.cli import main
from redetect.slam.errors import SlamError
from redetect.slam.formats.g2o import (
    RunGraph,
    first_disc_vertex,
    graph_of_run,
    read_g2o,
    write_g2o,
)
from redetect.slam.models import disc_in_robot, in_turned_axes
from redetect.slam.recording import read_recording, recording_of_frames

DEMO = Path(__file__).parents[2] / "images" / "e" / "map.circles"

POSES = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_XY 17 2 1\n"
STEP = "EDGE_SE2 0 1 1 0 0 100 0 0 100 0 400\n"
SIGHT = "EDGE_SE2_XY 1 17 1 1 100 0 100\n"


def check_same(again: RunGraph, graph: RunGraph) -> None:
    """Positions and estimates to the bit, covariances to the last digits of their inversion."""
    one, other = again.recording, graph.recording
    np.testing.assert_array_equal(one.steps, other.steps)
    np.testing.assert_allclose(one.step_covariance, other.step_covariance, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(one.circles.frame, other.circles.frame)
    np.testing.assert_array_equal(one.circles.ids, other.circles.ids)
    np.testing.assert_array_equal(one.circles.xy, other.circles.xy)
    np.testing.assert_allclose(one.circles.covariance, other.circles.covariance, rtol=1e-9)
    np.testing.assert_array_equal(again.poses, graph.poses)
    np.testing.assert_array_equal(again.discs, graph.discs)
    np.testing.assert_array_equal(again.disc_ids, graph.disc_ids)


def chi2(graph: RunGraph) -> float:
    """The error of a graph by this project's models, in the data set's axes."""
    error = between(graph.poses[:-1], graph.poses[1:]) - graph.recording.steps
    error[:, 2] = wrap_angle(error[:, 2])
    place = dict(zip(graph.disc_ids.tolist(), graph.discs))
    rows = graph.recording.circles
    discs = np.array([place[number] for number in rows.ids.tolist()])
    missed = disc_in_robot(graph.poses[rows.frame + 1], discs) - rows.xy
    return float(
        np.einsum("ni,nij,nj", error, np.linalg.inv(graph.recording.step_covariance), error)
        + np.einsum("ni,nij,nj", missed, np.linalg.inv(rows.covariance), missed)
    )


def chi2_by_the_formats_rules(file: Path) -> float:
    """The error of a file's graph, as g2o's edges define it; written apart from what is tested."""
    vertices: dict[str, FloatArray] = {}
    total = 0.0
    for line in file.read_text().splitlines():
        tag, *words = line.split()
        if tag.startswith("VERTEX"):
            vertices[words[0]] = np.array(words[1:], dtype=np.float64)
        elif tag.startswith("EDGE"):
            first, second = vertices[words[0]], vertices[words[1]]
            numbers = np.array(words[2:], dtype=np.float64)
            size = len(second)
            seen = rotation(first[2]).T @ (second[:2] - first[:2])
            error = seen - numbers[:2]
            if size == 3:
                # (measured)^-1 * (first^-1 * second)
                turn = wrap_angle(second[2] - first[2] - numbers[2])
                error = np.append(rotation(numbers[2]).T @ error, turn)
            information = np.zeros((size, size))
            information[np.triu_indices(size)] = numbers[size:]
            information += np.triu(information, 1).T
            total += float(error @ information @ error)
    return total


def test_the_demo_run_comes_back(tmp_path: Path) -> None:
    graph = graph_of_run(read_recording(DEMO))
    write_g2o(tmp_path / "e.g2o", graph)
    check_same(read_g2o(tmp_path / "e.g2o"), graph)


@pytest.mark.long
def test_the_real_run_comes_back(tmp_path: Path, shared_data: Path) -> None:
    graph = graph_of_run(read_recording(shared_data / "dlr" / "map.circles"))
    assert len(graph.recording.circles) == 14309
    write_g2o(tmp_path / "e.g2o", graph)
    check_same(read_g2o(tmp_path / "e.g2o"), graph)


def test_the_graphs_error_is_that_of_the_models(tmp_path: Path) -> None:
    """Fails where covariances are left unrotated, by the axes or by the step's turn."""
    graph = noisy(graph_of_run(read_recording(DEMO)))
    write_g2o(tmp_path / "e.g2o", graph)
    expected = chi2(graph)
    assert expected > 1000.0
    assert chi2_by_the_formats_rules(tmp_path / "e.g2o") == pytest.approx(expected, rel=1e-9)
    # What the known mistakes would give is far off.
    for covariance in (
        graph.recording.step_covariance[:, [1, 0, 2]][:, :, [1, 0, 2]],
        in_turned_axes(graph.recording.step_covariance, -graph.recording.steps[:, 2]),
    ):
        wrong = replace(graph.recording, step_covariance=covariance)
        assert abs(chi2(graph._replace(recording=wrong)) / expected - 1.0) > 1e-4


def noisy(graph: RunGraph) -> RunGraph:
    """Estimates off the measurements, so that there is an error; sharper turns than real ones."""
    rng = np.random.default_rng(7)
    poses = graph.poses + rng.normal(0.0, 0.02, graph.poses.shape)
    discs = graph.discs + rng.normal(0.0, 0.05, graph.discs.shape)
    steps = graph.recording.steps + rng.normal(0.0, [0.0, 0.0, 0.5], graph.recording.steps.shape)
    turns = np.concatenate([[0.0], np.cumsum(steps[:, 2] - graph.recording.steps[:, 2])])
    poses[:, 2] += turns
    recording = replace(graph.recording, steps=steps)
    return graph._replace(recording=recording, poses=poses, discs=discs)


def test_covariances_at_the_steps_end_are_those_of_samples() -> None:
    rng = np.random.default_rng(8)
    root = rng.normal(size=(3, 3))
    covariance = root @ root.T
    step = np.array([0.3, -0.2, 1.1])
    noise = rng.multivariate_normal(np.zeros(3), covariance, 500)
    at_end = noise.copy()
    at_end[:, :2] = noise[:, :2] @ rotation(step[2])  # R^T to each
    expected = np.cov(at_end.T)
    turned = in_turned_axes(np.cov(noise.T)[None], step[None, 2])
    np.testing.assert_allclose(turned[0], expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(in_turned_axes(turned, -step[None, 2])[0], np.cov(noise.T))


def decimals(low: float, high: float, digits: int) -> st.SearchStrategy[float]:
    return st.integers(round(low * 10**digits), round(high * 10**digits)).map(
        lambda whole: whole / 10**digits
    )


@st.composite
def covariances(draw: st.DrawFn, size: int, largest: float) -> FloatArray:
    """Covariances of sane condition: deviations from 3 mm on, correlated."""
    sigma = np.array([draw(st.floats(0.003, largest)) for _ in range(size)])
    angles = [draw(st.floats(-1.0, 1.0)) for _ in range(3)]
    root = np.eye(size)
    root[1, :2] = [np.sin(angles[0]), np.cos(angles[0])]
    if size == 3:
        root[2] = [
            np.sin(angles[1]),
            np.cos(angles[1]) * np.sin(angles[2]),
            np.cos(angles[1]) * np.cos(angles[2]),
        ]
    return np.asarray(np.outer(sigma, sigma) * (root @ root.T))


@st.composite
def runs(draw: st.DrawFn) -> list[Frame]:
    frames = []
    for k in range(draw(st.integers(1, 4))):
        c = np.round(draw(covariances(3, 0.06)), 12) + 0.0  # a graph cannot hold -0
        x, y, angle = (draw(decimals(-4, 4, 5)) for _ in range(3))
        step = Step(f"r.{k}", x, y, angle, c[0, 0], c[0, 1], c[1, 1], c[0, 2], c[1, 2], c[2, 2])
        rows = []
        for _ in range(draw(st.integers(0, 3))):
            d = draw(covariances(2, 1.0)) + 0.0
            numbers = (draw(decimals(-9, 9, 5)), draw(decimals(-9, 9, 5)), draw(decimals(0, 1, 6)))
            number = draw(st.integers(0, 2**31 - 11))
            rows.append(CircleLandmark(*numbers, d[0, 0], d[0, 1], d[1, 1], (number,)))
        frames.append(Frame(step, tuple(rows)))
    return frames


@given(runs())
def test_any_run_comes_back(tmp_path_factory: pytest.TempPathFactory, frames: list[Frame]) -> None:
    file = tmp_path_factory.mktemp("g2o") / "a.g2o"
    graph = graph_of_run(recording_of_frames(frames, "a"))
    write_g2o(file, graph)
    check_same(read_g2o(file), graph)


def test_numbers_of_vertices() -> None:
    assert [first_disc_vertex(last) for last in (1, 9, 10, 80, 3297)] == [10, 10, 100, 100, 10000]


def test_a_file_of_another_tool_is_read(tmp_path: Path) -> None:
    """Edges before vertices, gaps in the numbers, no comments of ours."""
    file = tmp_path / "a.g2o"
    file.write_text(
        "EDGE_SE2_XY 7 8 1 0.5 100 0 25\nEDGE_SE2 3 7 1 0 0.1 100 0 0 100 0 400\n"
        "VERTEX_SE2 7 1 0 0.1\r\nVERTEX_XY 8 2 1\n# a comment\nVERTEX_SE2 3 0 0 0\nFIX 3\n"
    )
    graph = read_g2o(file)
    assert graph.recording.prefixes == ("vertex.7",)
    np.testing.assert_array_equal(graph.disc_ids, [8])
    np.testing.assert_array_equal(graph.recording.circles.ids, [8])
    # X forward 1, Y left 0.5: the data set's X left 0.5, Y backward -1.
    np.testing.assert_array_equal(graph.recording.circles.xy, [[0.5, -1.0]])
    np.testing.assert_allclose(graph.recording.circles.covariance, [[[0.04, 0.0], [0.0, 0.01]]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "0 VERTEX_SE2 rows: expected a run of at least one step"),
        (POSES + STEP + "EDGE_SE3:QUAT 1 2\n", ":5: row starts with 'EDGE_SE3:QUAT': expected VE"),
        (POSES + STEP.replace(" 400", ""), ":4: EDGE_SE2 .*expected two vertices"),
        (POSES + STEP + SIGHT.replace("17", "17.0"), ":5: EDGE_SE2_XY .*17.0 .*whole numbers"),
        (POSES + STEP + SIGHT.replace("17", "-1"), ":5: EDGE_SE2_XY .*expected two"),
        (POSES + STEP + SIGHT.replace("17", "99999999999"), ":5: EDGE_SE2_XY .*expected two"),
        (POSES + STEP + SIGHT.replace("17", "18"), ":5: EDGE_SE2_XY 1 18: expected a pose after"),
        (POSES + STEP + SIGHT.replace("1 17", "2 17"), ":5: EDGE_SE2_XY 2 17: expected a pose"),
        (POSES + STEP + SIGHT.replace("1 17", "0 17"), ":5: EDGE_SE2_XY 0 17: expected a pose"),
        (
            POSES + STEP + SIGHT.replace("1 17 1", "1 17 inf"),
            ":5: EDGE_SE2_XY .*finite numbers x y",
        ),
        (POSES + STEP + SIGHT.replace("100 0", "100 200"), ":5: the information matrix is not pos"),
        (POSES + STEP.replace("400", "-4"), ":4: the information matrix is not positive"),
        (POSES + STEP.replace("100 0 0 100 0 400", "1e-320 0 0 1e-320 0 1e-320"), ":4: the info"),
        (POSES + STEP + STEP, ":5: EDGE_SE2 0 1 is there already"),
        (POSES + STEP.replace("0 1 1", "1 0 1"), ":4: EDGE_SE2 from 1 to 0: expected edges from"),
        (POSES + STEP.replace("0 1 1", "0 9 1"), ":4: EDGE_SE2 from 0 to 9: expected"),
        (POSES, ": no EDGE_SE2 from 0 to 1"),
        (POSES + POSES, ":4: VERTEX_SE2 0 is there already"),
    ],
)
def test_what_is_no_run_is_refused_by_its_line(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "a.g2o").write_text(content)
    with pytest.raises(SlamError, match=message):
        read_g2o(tmp_path / "a.g2o")


@settings(max_examples=150)
@given(st.binary(max_size=60), st.integers(0, 200), st.integers(0, 30))
def test_damaged_files_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, junk: bytes, place: int, length: int
) -> None:
    whole = (POSES + STEP + SIGHT).encode()
    file = tmp_path_factory.mktemp("g2o") / "a.g2o"
    file.write_bytes(whole[:place] + junk + whole[place + length :])
    with contextlib.suppress(SlamError):
        graph = read_g2o(file)
        assert np.isfinite(graph.poses).all()
        assert np.isfinite(graph.recording.step_covariance).all()
        assert np.isfinite(graph.recording.circles.covariance).all()


def test_identifiers_that_have_no_vertex_are_refused(tmp_path: Path) -> None:
    step = Step("a", 0.3, -0.7, 1.234, 1e-4, 0.0, 4e-4, 0.0, 0.0, 1e-5)
    number = 2**31 - 10
    disc = CircleLandmark(1.0, -2.0, 0.5, 0.003, 0.0, 0.007, (number,))
    graph = graph_of_run(recording_of_frames([Frame(step, (disc,))], "a"))
    with pytest.raises(SlamError, match=f"disc {number}: expected an identifier of at most"):
        write_g2o(tmp_path / "a.g2o", graph)
    assert not (tmp_path / "a.g2o").exists()


def test_an_imported_graph_keeps_small_numbers(tmp_path: Path) -> None:
    """Fast frames have steps of micrometres, with covariances that 12 decimals make zero."""
    graph, run = tmp_path / "fast.g2o", tmp_path / "fast.circles"
    step = "EDGE_SE2 0 1 0.0012345678 0 4e-06 4e12 0 0 4e12 0 4e12\n"
    graph.write_text(POSES + step + SIGHT)
    assert main(["import", str(graph), "-o", str(run)]) == 0
    found, expected = read_recording(run), read_g2o(graph).recording
    np.testing.assert_array_equal(found.steps, expected.steps)
    np.testing.assert_array_equal(found.step_covariance, expected.step_covariance)
