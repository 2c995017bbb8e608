"""GTSAM's own reader of g2o finds the graph that was written, and the error of our models in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle
from redetect.landmarks.axes import from_dataset
from redetect.landmarks.map_file import write_table
from redetect.plane import between
from redetect.slam.formats.g2o import RunGraph, graph_of_run, write_g2o
from redetect.slam.formats.tables import odometry_table
from redetect.slam.models import disc_in_robot
from redetect.slam.recording import read_recording

gtsam: Any = pytest.importorskip("gtsam", reason="needs gtsam: pip install 'redetect[slam]'")

DOCUMENT = Path(__file__).parents[2] / "docs" / "slam" / "formats.md"
DEMO = Path(__file__).parents[2] / "images" / "e" / "map.circles"


def estimates_with_error(file: Path) -> RunGraph:
    """A run with estimates that are off by more than the measurements."""
    graph = graph_of_run(read_recording(file))
    rng = np.random.default_rng(11)
    poses = graph.poses + rng.normal(0.0, [0.01, 0.01, 0.02], graph.poses.shape)
    discs = graph.discs + rng.normal(0.0, 0.05, graph.discs.shape)
    return graph._replace(poses=poses, discs=discs)


def step_errors(graph: RunGraph) -> FloatArray:
    error = between(graph.poses[:-1], graph.poses[1:]) - graph.recording.steps
    error[:, 2] = wrap_angle(error[:, 2])
    return error


def disc_errors(graph: RunGraph) -> FloatArray:
    place = dict(zip(graph.disc_ids.tolist(), graph.discs))
    discs = np.array([place[number] for number in graph.recording.circles.ids.tolist()])
    return np.asarray(
        disc_in_robot(graph.poses[graph.recording.circles.frame + 1], discs)
        - graph.recording.circles.xy
    )


def squared(error: FloatArray, covariance: FloatArray) -> float:
    return float(np.einsum("ni,nij,nj", error, np.linalg.inv(covariance), error))


def check(graph: RunGraph, file: Path) -> None:
    factors, values = gtsam.readG2o(str(file), False)
    count = len(graph.recording.steps)
    assert factors.size() == count  # its reader leaves EDGE_SE2_XY out
    assert values.size() == count + 1 + len(graph.disc_ids)
    for number, pose in enumerate(from_dataset(graph.poses)):
        read = values.atPose2(number)
        np.testing.assert_array_equal([read.x(), read.y()], pose[:2])
        assert wrap_angle(read.theta() - pose[2]) == pytest.approx(0.0, abs=1e-12)

    # The plain error (measured)^-1 * between, weighed with the information that GTSAM read.
    total = 0.0
    for k in range(count):
        factor = factors.at(k)
        first, second = (values.atPose2(key) for key in list(factor.keys()))
        off = factor.measured().between(first.between(second))
        whitened = factor.noiseModel().R() @ [off.x(), off.y(), off.theta()]
        total += float(whitened @ whitened)
    assert total == pytest.approx(
        squared(step_errors(graph), graph.recording.step_covariance), rel=1e-8
    )

    # GTSAM measures the error by the logarithm, equal to first order in the turn.
    assert 2.0 * factors.error(values) == pytest.approx(total, rel=0.02)

    # The edges to discs as GTSAM's own geometry sees them, at the landmarks that it read.
    missed = 0.0
    for line in file.read_text().splitlines():
        tag, *words = line.split()
        if tag == "EDGE_SE2_XY":
            pose = values.atPose2(int(words[0]))
            disc = values.atPoint2(gtsam.symbol("l", int(words[1])))
            x, y, xx, xy, yy = map(float, words[2:])
            model = gtsam.noiseModel.Gaussian.Information(np.array([[xx, xy], [xy, yy]]))
            missed += 2.0 * model.loss(
                model.squaredMahalanobisDistance(pose.transformTo(disc) - [x, y])
            )
    expected = squared(disc_errors(graph), graph.recording.circles.covariance)
    assert missed == pytest.approx(expected, rel=1e-8)


def test_the_demo_run(tmp_path: Path) -> None:
    graph = estimates_with_error(DEMO)
    write_g2o(tmp_path / "e.g2o", graph)
    check(graph, tmp_path / "e.g2o")


@pytest.mark.long
def test_the_real_run(tmp_path: Path, shared_data: Path) -> None:
    folder = shared_data / "dlr"
    graph = estimates_with_error(folder / "map.circles")
    write_g2o(tmp_path / "e.g2o", graph)
    check(graph, tmp_path / "e.g2o")


@pytest.mark.long
def test_the_published_error_of_the_real_run(tmp_path: Path, shared_data: Path) -> None:
    """At the least-squares solution all of a file's edges give the published chi squared."""
    folder = shared_data / "dlr"
    graph = graph_of_run(read_recording(folder / "map.circles"))
    table = np.loadtxt(folder / "least_squares_map.csv", delimiter=",")
    assert np.array_equal(table[:, 0].astype(int), graph.disc_ids)
    poses = np.loadtxt(folder / "least_squares_path.csv", delimiter=",")
    solved = graph._replace(poses=poses, discs=table[:, 1:])
    write_g2o(tmp_path / "e.g2o", solved)
    check(solved, tmp_path / "e.g2o")
    total = squared(step_errors(solved), solved.recording.step_covariance)
    total += squared(disc_errors(solved), solved.recording.circles.covariance)
    assert total == pytest.approx(56_871.45, abs=0.1)


@pytest.mark.lowest
def test_the_documented_way_from_the_tables_to_factors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The program in docs/slam/formats.md makes the factors that GTSAM reads from the g2o file."""
    graph = estimates_with_error(DEMO)
    write_g2o(tmp_path / "e.g2o", graph)
    factors, values = gtsam.readG2o(str(tmp_path / "e.g2o"), False)
    (tmp_path / "TABLES").mkdir()
    table = odometry_table(read_recording(DEMO))
    write_table(tmp_path / "TABLES" / "odometry.csv", *table, ["a comment"])
    program = DOCUMENT.read_text().split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    made: dict[str, Any] = {}
    exec(program, made)
    assert made["graph"].size() == 80
    assert made["graph"].error(values) == pytest.approx(factors.error(values), rel=1e-9)
