"""Files of settings: written, read, run again, and refused in words."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from detect.cli import main, parsed
from detect.errors import DetectError
from detect.line_settings import PRESETS as LINE_PRESETS
from detect.line_settings import LineSettings
from detect.options import All, Circles
from detect.settings import PRESETS, CircleSettings, MarkerSettings
from detect.settings_files import SettingsFile, read_settings, settings_text
from tests.detect.commands import Captured


@pytest.mark.parametrize("circles", PRESETS.values())
@pytest.mark.parametrize("lines", LINE_PRESETS.values())
def test_come_back(tmp_path: Path, circles: CircleSettings, lines: LineSettings) -> None:
    circles, markers = replace(circles, radius_m=0.1 / 3.0), MarkerSettings(ids=(1, 2))
    path = tmp_path / "s.json"
    path.write_text(settings_text(circles=circles, lines=lines, markers=markers))
    read = read_settings(path)
    assert (read.circles, read.lines, read.markers) == (circles, lines, markers)
    path.write_text('{"settings": {}}')
    assert read_settings(path) == SettingsFile()


def test_flags_start_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "s.json"
    path.write_text('{"settings": {"circles": {"radius_m": 0.06, "threshold": 0.7}}}')
    command = parsed(["circles", "run", "--settings", str(path), "--threshold", "0.4"])
    assert isinstance(command, Circles)
    assert command.detector == CircleSettings(radius_m=0.06, threshold=0.4)
    both = parsed(["all", "run", f"--settings={path}"])
    assert isinstance(both, All)
    assert both.circles.radius_m == 0.06
    assert both.lines == LineSettings()


def test_what_ran_runs_again(project_root: Path, tmp_path: Path) -> None:
    """The log of a result is a file of settings."""
    run = str(project_root / "images" / "e")
    first, second = tmp_path / "a", tmp_path / "b"
    flags = ["--frames", "3", "--tilt", "none"]
    assert main(["all", run, "-o", str(first), "--quality-threshold", "0.62", *flags]) == 0
    log = str(first / "detected.log.json")
    assert main(["all", run, "-o", str(second), "--settings", log, *flags]) == 0
    for name in ("detected.circles", "detected.lines"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    assert "threshold=0.62" in (second / "detected.circles").read_text()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("nonsense", "not JSON"),
        pytest.param("[" * 100_000, "not JSON", id="deep"),
        ("[]", 'no "settings"'),
        ('{"settings": 3}', 'no "settings"'),
        (
            '{"settings": {"circels": {}}}',
            "settings of 'circels': expected those of circles, lines, markers",
        ),
        ('{"settings": {"circles": 3}}', "names and values"),
        ('{"settings": {"circles": {"radius": 1}}}', "radius is not a parameter of CircleSettings"),
        ('{"settings": {"circles": {"radius_m": "1"}}}', "expected a number"),
        ('{"settings": {"circles": {"refine": 1}}}', "expected True or False"),
        ('{"settings": {"circles": {"radius_m": -1}}}', "radius_m"),
        ('{"settings": {"lines": {"refine_steps_px": 3}}}', "expected a list of numbers"),
        ('{"settings": {"circles": {"polarity": "grey"}}}', "expected one of any, light, dark"),
        ('{"settings": {"circles": {"samples": 16.5}}}', "expected a whole number"),
    ],
)
def test_refusals(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "s.json"
    path.write_text(content)
    with pytest.raises(DetectError, match=words) as told:
        read_settings(path)
    assert str(path) in str(told.value)
    assert json.dumps(str(told.value))


def test_a_missing_file_is_one_line(tmp_path: Path, capsys: Captured) -> None:
    missing = str(tmp_path / "none.json")
    assert main(["circles", "run", "--settings", missing]) == 1
    assert capsys.readouterr().err.startswith(f"error: {missing}: no such settings file")
