"""Wheel and source distribution hold all that they should, and nothing else."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOMS = ("camera", "detect", "lut", "redetect")
#: What the project has beside its rooms.
BESIDE = ("conda", "docs", "examples", "images", "requirements", "ros", "tests", "tools")
SINGLE = (
    "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "Dockerfile", "LICENSE", "MANIFEST.in",
    "Makefile", "README.md", "SECURITY.md",
)  # fmt: skip
_MADE = shutil.ignore_patterns("__pycache__", "*.pyc", ".*.part", "*.part", "detected.*", "api")


def files_below(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def source(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the project without what its use leaves behind."""
    copy = tmp_path_factory.mktemp("source")
    for folder in (*ROOMS, *BESIDE, ".ci"):
        shutil.copytree(project_root / folder, copy / folder, ignore=_MADE)
    for name in (*SINGLE, "pyproject.toml"):
        shutil.copy(project_root / name, copy / name)
    return copy


@pytest.fixture(scope="module")
def distributions(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the source distribution, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(source)]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.mark.long
def test_the_wheel_has_the_rooms_and_nothing_else(source: Path, distributions: Path) -> None:
    (wheel,) = distributions.glob("*.whl")
    with zipfile.ZipFile(wheel) as opened:
        found = {name for name in opened.namelist() if ".dist-info/" not in name}
        (entry_points,) = (n for n in opened.namelist() if n.endswith("entry_points.txt"))
        commands = opened.read(entry_points).decode()
    expected = {
        f"{room}/{name}"
        for room in ROOMS
        for name in files_below(source / room)
        if name.endswith((".py", ".npz", ".html")) or name == "py.typed" or name.startswith("demo/")
    }
    assert found == expected
    assert {name.partition("/")[0] for name in found if name.endswith("/py.typed")} == set(ROOMS)
    assert "camera = camera.cli:main" in commands
    assert "redetect = redetect.__main__:main" in commands
    for command in ("groundtruth", "slam"):
        assert f"{command} = redetect.{command}.cli:main" in commands
    assert "detect = detect.__main__:main" in commands  # workers import no command line


@pytest.mark.long
def test_the_source_distribution_is_complete(source: Path, distributions: Path) -> None:
    (archive,) = distributions.glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        found = {member.name.partition("/")[2] for member in opened if member.isfile()}
    expected = {
        f"{folder}/{name}" for folder in (*ROOMS, *BESIDE) for name in files_below(source / folder)
    }
    made = {"PKG-INFO", "setup.cfg", "pyproject.toml", ".ci/run"}
    egg = {name for name in found if name.startswith("redetect.egg-info/")}
    assert found - egg - made == expected | set(SINGLE)
