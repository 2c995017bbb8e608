"""A run that ends early, and what it writes when nothing happens to it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from detect.cli import main
from tests.detect.commands import Captured
from tests.detect.forked_runs import ForkedRuns, forked_runs
from tests.detect.interrupted_runs import Trial, a_run, results


@pytest.fixture(scope="session")
def run_folder(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that is not to be changed."""
    return a_run(project_root, tmp_path_factory.mktemp("run") / "e")


@pytest.fixture(scope="session")
def undisturbed(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What the run writes when nothing happens to it."""
    output = tmp_path_factory.mktemp("undisturbed")
    assert main(["all", str(run_folder), "-o", str(output)]) == 3
    return results(output)


@pytest.fixture
def trial(
    run_folder: Path, undisturbed: dict[str, bytes], tmp_path: Path, capsys: Captured
) -> Trial:
    """The run with an empty folder for its results."""
    (tmp_path / "output").mkdir()
    return Trial(run_folder, tmp_path / "output", undisturbed, capsys)


@pytest.fixture(scope="module")
def runs(
    run_folder: Path, undisturbed: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ForkedRuns]:
    """Starts runs in processes of their own; the kernels have been compiled."""
    with forked_runs(run_folder, tmp_path_factory.mktemp("forked")) as started_runs:
        yield started_runs
