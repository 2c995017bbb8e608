"""Options and data shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

# As the command lines have it, and before NumPy is loaded: threads that wait for each other beside
# other workers make small matrices many times slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

from camera import Camera, parse_camera

# Compiling takes longer than any deadline, and a test that fails must fail again.
settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")

ROOT = Path(__file__).resolve().parent.parent

PUBLISHED_CAM = """\
{ SmRadialDistortedCamera
sensor2Tcp: [ 0.99992, -0.00994383, -0.00778315, -0.0820676 ]
[ 0.00718218, -0.0591054, 0.998226, 0.142944 ]
[ -0.0103862, -0.998202, -0.0590291, 0.0522051 ]
sensor2World: [ -0.99992, 0.00994383, 0.00778315, 0.0179777 ]
[ -0.00211987, 0.475426, -0.879753, -0.0808609 ]
[ -0.0124484, -0.879699, -0.475367, 1.50354 ]
mountIndex: 0
width: 768 height: 288 scaleX: 464.762 scaleY: 232.381 offsetX: 384 offsetY: 144
coef: { -0.0620672 -0.324903 0.314764 1.52524 -0.480806 }
}
"""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--run",
        action="append",
        default=[],
        metavar="DIR",
        help="also re-detect this run folder and compare with its shipped rows (repeatable)",
    )


#: Files whose tests take longest, so that they are begun first: at the end no worker is left alone
#: with one of them. The first compiles the detectors' kernels, which takes minutes; those after it
#: need none of them, so that the other worker does not compile the same ones at the same time.
LONGEST_FILES = (
    "tests/detect/runs/test_determinism.py",
    "tests/tools/reenactment/test_prepare.py",
    "tests/camera/test_calibration.py",
    "tests/camera/test_calibrate_command.py",
    "tests/groundtruth/markers/test_rig.py",
    "tests/groundtruth/clocks/test_sync.py",
    "tests/groundtruth/markers/test_refinement.py",
    "tests/groundtruth/markers/test_network.py",
    "tests/tools/simulator/test_simulated_run.py",
    "tests/docs/test_examples.py",
    "tests/detect/runs/test_concurrent.py",
    "tests/detect/runs/test_killed.py",
    "tests/detect/discs/test_centres.py",
    "tests/detect/markers/test_detect.py",
    "tests/detect/verticals/test_step.py",
    "tests/detect/runs/test_workers.py",
    "tests/camera/test_calibrate_photographs.py",
    "tests/detect/sources/test_memory.py",
    "tests/groundtruth/fusion/test_fuse.py",
    "tests/tools/evaluation/test_marker_evaluation.py",
    "tests/detect/runs/test_full_disks.py",
    "tests/groundtruth/lasers/test_alignment.py",
    "tests/tools/benchmark/test_benchmark.py",
    "tests/tools/soak/test_soak.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order files by how long they take, if all are run; their tests stay as they are."""
    missing = [name for name in LONGEST_FILES if not (ROOT / name).is_file()]
    if missing:
        raise pytest.UsageError(f"tests/conftest.py: no such file: {', '.join(missing)}")
    if set(LONGEST_FILES) <= {_file_of(item) for item in items}:
        places = {name: place for place, name in enumerate(LONGEST_FILES)}
        items.sort(key=lambda item: places.get(_file_of(item), len(places)))


def _file_of(item: pytest.Item) -> str:
    return item.nodeid.partition("::")[0]


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
