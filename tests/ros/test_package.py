"""The package of ROS 2 says the same in all its files, and what is true of the project."""

from __future__ import annotations

import ast
import re
import tomllib
from configparser import ConfigParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from redetect import __version__


@pytest.fixture
def package(project_root: Path) -> Path:
    return project_root / "ros" / "redetect_ros"


@pytest.fixture
def manifest(package: Path) -> ElementTree.Element:
    return ElementTree.parse(package / "package.xml").getroot()


@pytest.fixture
def setup(package: Path) -> dict[str, Any]:
    """The arguments of `setup`."""
    tree = ast.parse((package / "setup.py").read_text())
    (call,) = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return {str(one.arg): ast.literal_eval(one.value) for one in call.keywords}


def constants(package: Path) -> dict[str, Any]:
    """The module's assignments whose values are literals."""
    found = {}
    for node in ast.parse((package / "redetect_ros" / "node.py").read_text()).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            found[node.targets[0].id] = ast.literal_eval(node.value)
    return found


def test_name_version_and_licence(setup: dict[str, Any], manifest: ElementTree.Element) -> None:
    for key in ("name", "version", "description", "license"):
        assert manifest.findtext(key) == setup[key]
    assert setup["version"] == __version__
    assert setup["name"] == "redetect_ros"
    assert setup["packages"] == ["redetect_ros"]
    assert manifest.findtext("export/build_type") == "ament_python"


def test_ament_finds_what_is_installed(package: Path, setup: dict[str, Any]) -> None:
    assert all((package / file).is_file() for _, files in setup["data_files"] for file in files)
    folders = {file: folder for folder, files in setup["data_files"] for file in files}
    assert folders["resource/redetect_ros"] == "share/ament_index/resource_index/packages"
    assert folders["package.xml"] == "share/redetect_ros"
    config = ConfigParser()
    config.read(package / "setup.cfg")
    assert config["install"]["install_scripts"] == "$base/lib/redetect_ros"
    assert config["develop"]["script_dir"] == "$base/lib/redetect_ros"


def test_the_manifest_names_what_is_imported(
    package: Path, project_root: Path, manifest: ElementTree.Element
) -> None:
    named = {element.text for element in manifest.findall("exec_depend")}
    text = (package / "redetect_ros" / "node.py").read_text()
    imported = set(re.findall(r"^(?:import|from) (\w*(?:rclpy|ros\w*))", text, re.M))
    conversion = (project_root / "detect" / "ros_messages.py").read_text()
    messages = set(re.findall(r"(\w+)/msg/", text + conversion))
    assert imported == {"rclpy", "rosidl_runtime_py"}
    assert imported | messages | {"launch_xml", "launch_ros"} == named


def test_the_launch_file_starts_the_node(
    package: Path, project_root: Path, setup: dict[str, Any]
) -> None:
    launch = ElementTree.parse(package / "launch" / "redetect.launch.xml").getroot()
    (node,) = launch.findall("node")
    (script,) = setup["entry_points"]["console_scripts"]
    assert node.get("pkg") == setup["name"]
    assert script == f"{node.get('exec')} = redetect_ros.node:main"
    # Else pip would put it in the place of the project's own command.
    project = tomllib.loads((project_root / "pyproject.toml").read_text())["project"]
    assert node.get("exec") not in project["scripts"]
    arguments = {element.get("name") for element in launch.findall("arg")}
    parameters = {element.get("name") for element in node.findall("param")}
    assert parameters <= constants(package)["PARAMETERS"].keys()
    assert arguments == parameters | {"image"}
    (remap,) = node.findall("remap")
    assert (remap.get("from"), remap.get("to")) == ("image", "$(var image)")


def test_the_readme_has_all_parameters(package: Path) -> None:
    text = (package / "README.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \| `?(.*?)`? \|", text, re.M))
    written = {
        name: f'"{default}"' if isinstance(default, str) else str(default).lower()
        for name, default in constants(package)["PARAMETERS"].items()
    }
    assert rows == written
