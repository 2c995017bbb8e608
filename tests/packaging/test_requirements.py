"""The ends of what `pyproject.toml` allows are what is tried: the lowest versions, and the lock."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from redetect import __version__


def declared(root: Path, extras: tuple[str, ...]) -> dict[str, Requirement]:
    """What the project needs, by itself and with extras."""
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    optional = project["optional-dependencies"]
    lines = [*project["dependencies"], *(line for extra in extras for line in optional[extra])]
    return {canonicalize_name(r.name): r for r in map(Requirement, lines)}


def pinned(path: Path) -> dict[str, Version]:
    """The versions that a file of requirements names, one for each package."""
    lines = [line.rstrip(" \\") for line in path.read_text().splitlines()]
    named = [line.partition("==") for line in lines if re.match(r"\w", line)]
    assert all(between for _, between, _ in named)
    return {canonicalize_name(name): Version(version) for name, _, version in named}


def lower_end(requirement: Requirement) -> Version:
    (lowest,) = [Version(s.version) for s in requirement.specifier if s.operator == ">="]
    return lowest


def test_what_users_need_has_a_lower_and_an_upper_end(project_root: Path) -> None:
    project = tomllib.loads((project_root / "pyproject.toml").read_text())["project"]
    for line in project["dependencies"]:
        requirement = Requirement(line)
        assert {s.operator for s in requirement.specifier} == {">=", "<"}, line


def test_the_lowest_versions_are_those_that_are_allowed(project_root: Path) -> None:
    """Of all that users may need: the declared ends, to the last digit that they give."""
    found = pinned(project_root / "requirements" / "lowest.txt")
    wanted = declared(project_root, ("cluster", "bags", "dxf", "parquet", "view", "slam"))
    assert set(wanted) <= set(found)
    tools = declared(project_root, ("dev",))
    for name in set(found) & (set(wanted) | set(tools)):
        end, version = lower_end((wanted | tools)[name]), found[name]
        assert version.release[: len(end.release)] == end.release, name
        assert all(part == 0 for part in version.release[len(end.release) : 3]), name
        assert version.pre == end.pre, name


def test_the_lowest_versions_are_what_is_installed(project_root: Path) -> None:
    folder = project_root / "requirements"
    locked = pinned(folder / "lowest-lock.txt")
    assert pinned(folder / "lowest.txt").items() <= locked.items()


@pytest.mark.parametrize(
    "extras", [(), ("cluster", "bags", "dxf", "parquet", "view", "slam"), ("dev",)]
)
def test_the_lock_is_within_what_is_allowed(project_root: Path, extras: tuple[str, ...]) -> None:
    found = pinned(project_root / "requirements" / "lock.txt")
    for name, requirement in declared(project_root, extras).items():
        assert requirement.specifier.contains(found[name], prereleases=True), name


@pytest.mark.parametrize("name", ["lock.txt", "lowest-lock.txt"])
def test_every_locked_package_has_hashes(project_root: Path, name: str) -> None:
    path = project_root / "requirements" / name
    entries = re.split(r"\n(?=\w)", path.read_text())
    assert len(entries) == len(pinned(path))
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", entry) for entry in entries)


def test_ci_tries_both_ends(project_root: Path) -> None:
    commands = (project_root / ".ci" / "run").read_text().splitlines()
    assert commands.index("make test") < commands.index("make lowest")


#: Packages that conda-forge calls otherwise.
_IN_CONDA = {"matplotlib": "matplotlib-base", "opencv-python-headless": "opencv"}


def test_the_recipe_for_conda_needs_what_the_project_needs(project_root: Path) -> None:
    recipe = (project_root / "conda" / "meta.yaml").read_text()
    for name, requirement in declared(project_root, ()).items():
        low, high = sorted((str(s) for s in requirement.specifier), key=lambda s: s[:2] != ">=")
        assert f"- {_IN_CONDA.get(name, name)} {low},{high}\n" in recipe
    project = tomllib.loads((project_root / "pyproject.toml").read_text())["project"]
    for name, place in project["scripts"].items():
        assert f"- {name} = {place}\n" in recipe


def test_the_version_is_the_same_everywhere(project_root: Path) -> None:
    assert (
        f'{{% set version = "{__version__}" %}}'
        in (project_root / "conda" / "meta.yaml").read_text()
    )
    assert f"\nversion: {__version__}\n" in (project_root / "CITATION.cff").read_text()


def test_the_readme_is_short_and_says_how_to_install(project_root: Path) -> None:
    lines = (project_root / "README.md").read_text().splitlines()
    assert len(lines) <= 150
    assert any("pip install redetect" in line for line in lines)
