"""Numbers that documents state as defaults are those of the code."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from camera.boards.points import _SEARCHED_PX
from camera.calibration.calibrate import _ASPECT_SIGMA
from camera.calibration.choice import _POLYNOMIAL_WORTH, _TANGENTIAL_WORTH
from camera.calibration.start import _FOCAL_WIDTHS
from camera.formats.conversion import _NEAR_PX
from detect.discs.hough import _MOST_DOUBTFUL
from detect.discs.judgement import SPARSE_DIRECTIONS, SPARSE_RADII
from detect.discs.rim import DIRECTIONS
from detect.line_settings import LineSettings
from detect.settings import (
    LEAST_FRAMES,
    PUBLISHED,
    REPORT,
    USUAL_TILT_DEG,
    CircleSettings,
    MarkerSettings,
)
from redetect.cli import PROGRAMS
from tests.docs.blocks import documents

_NUMBER = r"(\d*\.?\d+)"
#: `--flag`, 0.3 and `--flag` (0.3), and what it is of before it: 0.3 px (`--flag`).
_AFTER = re.compile(rf"`--([a-z][\w.-]*)`(?:, | \(){_NUMBER}\b(?! for)")
_BEFORE = re.compile(rf"{_NUMBER}( ?[a-z%°]+)? \(`--([a-z][\w.-]*)`\)")

DISCS, MARKERS, LINES = CircleSettings(), MarkerSettings(), LineSettings()

#: What documents say without naming a flag: the page, the sentence with its numbers, and these.
SENTENCES: list[tuple[str, str, list[float]]] = [
    ("README.md", r"instead of the usual #°", [USUAL_TILT_DEG]),
    ("docs/discs.md", r"# grey values are sampled on each", [DISCS.samples]),
    ("docs/discs.md", r"# pairs of samples at # and # radii; at least # pairs",
     [PUBLISHED.samples, PUBLISHED.inner_ring, PUBLISHED.outer_ring, PUBLISHED.least_pairs]),
    ("docs/discs.md", r"quality above # and contrast above # grey levels",
     [PUBLISHED.threshold, PUBLISHED.least_contrast]),
    ("docs/discs.md", r"circles of # and # radii, every pixel, all maxima of at least #",
     [REPORT.inner_ring, REPORT.outer_ring, REPORT.threshold]),
    ("docs/discs.md", r"# of # pairs at # and # radii, quality > #, contrast > #",
     [PUBLISHED.least_pairs, PUBLISHED.samples, PUBLISHED.inner_ring, PUBLISHED.outer_ring,
      PUBLISHED.threshold, PUBLISHED.least_contrast]),
    ("docs/discs.md", r"the best within # radii on the floor", [DISCS.separation]),
    ("docs/discs.md", r"the rim is traced in # directions", [DIRECTIONS]),
    ("docs/discs.md", r"at # directions times # pixels", [SPARSE_DIRECTIONS, len(SPARSE_RADII)]),
    ("docs/discs.md", r"the best # centres of either polarity", [_MOST_DOUBTFUL]),
    ("docs/discs.md", r"fewer than # of them .*? at least #°", [LEAST_FRAMES, USUAL_TILT_DEG]),
    ("docs/verticals.md", r"by voting within ±#°", [LINES.largest_tilt_deg]),
    ("docs/markers.md", r"takes #, #, #, # and #", list(MARKERS.thresholds)),
    ("docs/camera.md", r"leave it open by more than #", [_ASPECT_SIGMA]),
    ("docs/camera.md", r"reduced to # pixels along the longer side, .*? to #,", [*_SEARCHED_PX]),
    ("docs/camera.md", r"lengths from # to # image widths", [_FOCAL_WIDTHS[0], _FOCAL_WIDTHS[-1]]),
    ("docs/camera.md", r"by at least # variances of a coordinate", [_TANGENTIAL_WORTH]),
    ("docs/camera.md", r"or if that is at least # variances lower", [_POLYNOMIAL_WORTH]),
    ("docs/camera.md", r"stays above # px, with polynomial", [_NEAR_PX]),
]  # fmt: skip


def flags_with_defaults() -> dict[str, set[Any]]:
    """The defaults of all commands' flags, by the last part of their names."""
    found: dict[str, set[Any]] = defaultdict(set)
    for program in PROGRAMS.values():
        for kind in import_module(program).PROGRAM.commands.values():
            for name, default in defaults_of(kind):
                found[name.replace("_", "-")].add(default)
    return found


def defaults_of(kind: Any) -> Iterator[tuple[str, Any]]:
    """Names and defaults of a dataclass's fields, and of those of dataclasses in it."""
    for each in fields(kind):
        default = each.default
        if default is MISSING and each.default_factory is not MISSING:
            default = each.default_factory()
        if is_dataclass(default):
            yield from defaults_of(default)
        elif default is not MISSING:
            yield each.name, default


def stated_flags(text: str) -> Iterator[tuple[str, float]]:
    """The flags that a document states a default of, and the default."""
    for flag, number in _AFTER.findall(text):
        yield flag, float(number)
    for number, unit, flag in _BEFORE.findall(text):
        yield flag, float(number) / (100.0 if unit.strip() == "%" else 1.0)
    for row in re.findall(r"^\| `--.*\|$", text, flags=re.M):
        first, *_, last = row.strip("|").split("|")
        names, numbers = re.findall(r"`--([\w.-]+)`", first), re.findall(_NUMBER, last)
        if len(names) == len(numbers):
            yield from zip(names, map(float, numbers))


def test_flags_have_the_defaults_that_are_stated(project_root: Path) -> None:
    known = flags_with_defaults()
    stated = [
        (document.name, flag, number)
        for document in documents(project_root)
        for flag, number in stated_flags(document.read_text("utf-8"))
    ]
    assert len(stated) > 12
    wrong = [
        (page, flag, number, known[name])
        for page, flag, number in stated
        if (name := flag.rpartition(".")[2]) in known and number not in known[name]
    ]
    assert not wrong


@pytest.mark.parametrize(("page", "sentence", "values"), SENTENCES)
def test_sentences_state_the_codes_numbers(
    project_root: Path, page: str, sentence: str, values: list[float]
) -> None:
    text = " ".join((project_root / page).read_text("utf-8").split())
    found = re.search(sentence.replace("#", _NUMBER).replace(" ", r"\s+"), text)
    assert found is not None, f"{page} no longer says: {sentence}"
    assert [float(number) for number in found.groups()] == pytest.approx(values)


def test_a_wrong_default_is_noticed() -> None:
    text = "(`--limit-px`, 7), `--gate` (3), 99 % (`--kept-probability`)\n| `--a` | 5 m |\n"
    assert list(stated_flags(text)) == [
        ("limit-px", 7.0), ("gate", 3.0), ("kept-probability", 0.99), ("a", 5.0)
    ]  # fmt: skip
    assert 7.0 not in flags_with_defaults()["limit-px"]
