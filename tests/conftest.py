"""Options and data shared by all tests."""

from __future__ import annotations

import gc
import inspect
import os
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

# As the command lines have it, and before NumPy is loaded: threads that wait for each other beside
# other workers make small matrices many times slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

from camera import Camera, parse_camera
from tools.published_camera import PUBLISHED_CAM

# Compiling takes longer than any deadline, and a test that fails must fail again. A third of the
# examples of the default: the same ones each time, more of them tell little.
settings.register_profile("project", deadline=None, derandomize=True, max_examples=30)
settings.load_profile("project")

# The help of flags is read out of the source each time that a command line is parsed.
inspect.getsource = lru_cache(maxsize=None)(inspect.getsource)  # type: ignore[assignment]

ROOT = Path(__file__).resolve().parent.parent


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--run",
        action="append",
        default=[],
        metavar="DIR",
        help="also re-detect this run folder and compare with its shipped rows (repeatable)",
    )


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """What is collected stays: the collector of garbage need not look through it again."""
    del session
    gc.disable()
    yield
    gc.freeze()
    gc.set_threshold(50_000)
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with long tests come first, for each worker: what the last ones share is short.

    Each of them begins with a part of the items, one after the other, of as many.
    """
    long = {item.path for item in items if item.get_closest_marker("long")}
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    parts: list[list[pytest.Item]] = [[] for _ in range(workers)]
    for path in sorted(files, key=lambda path: path not in long):
        min(parts, key=len).extend(files[path])
    items[:] = [item for part in parts for item in part]


@pytest.fixture(scope="session")
def published_cam_text() -> str:
    """The calibration of run e as the report prints it."""
    return PUBLISHED_CAM


@pytest.fixture(scope="session")
def published_camera() -> Camera:
    return parse_camera(PUBLISHED_CAM)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of photographs and numbers with truth that is not part of the project."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the evaluation data (../shared/data) is not on this machine")
    return folder


@pytest.fixture(scope="session")
def given_runs(request: pytest.FixtureRequest) -> list[Path]:
    """The run folders given by ``--run`` that are there, with shipped rows."""
    given = [Path(run) for run in request.config.getoption("--run")]
    runs = [run for run in given if (run / "map.circles").is_file()]
    if not runs:
        pytest.skip(
            "no run folder with map.circles was given by --run: the DLR Spatial Cognition data set "
            "is published by the University of Bremen's group AG EBV (docs/data.md)"
        )
    return runs


@pytest.fixture(scope="session")
def project_root() -> Path:
    return ROOT
