"""Pages that quote figures are those that their templates and the figures' files make."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from jinja2 import UndefinedError

from tools.evaluation.__main__ import STUDIES, main
from tools.evaluation.figures import documents, numbers_in
from tools.evaluation.tables import Table

#: Studies that measure nothing.
_OTHERS = {"documents", "pictures", "train-rim-network", "tutorial-photographs"}


def test_pages_are_those_of_their_templates_and_figures(project_root: Path) -> None:
    pages = documents(project_root)
    assert {"README.md", "measured.md", "disturbed.md"} <= {page.name for page in pages}
    changed = [
        page.relative_to(project_root).as_posix()
        for page, text in pages.items()
        if page.read_text("utf-8") != text
    ]
    assert not changed, "python -m tools.evaluation documents makes them; edit the .jinja instead"


def test_files_of_figures_are_made_by_one_command_each_and_quoted(project_root: Path) -> None:
    folder = project_root / "docs" / "figures"
    makefile = (project_root / "tools/evaluation/figures.mk").read_text("utf-8")
    listed = re.search(r"^FIGURES \?= (.*?)\n\n", makefile, flags=re.M | re.S)
    assert listed is not None
    names = {path.stem for path in folder.glob("*.json")}
    assert names == {*listed[1].replace("\\", "").split(), "left-out"}
    text = "".join(path.read_text("utf-8") for path in documents_templates(project_root))
    assert {
        name for name in names if not re.search(rf"\b{name.replace('-', '_')}\b", text)
    } == set()
    for path in folder.glob("*.json"):
        command = json.loads(path.read_text("utf-8"))["command"].split()
        if path.stem == "speed":
            assert command[2] == "tools.benchmark"
        elif path.stem != "left-out":
            assert command[3] in STUDIES.keys() - _OTHERS


def documents_templates(root: Path) -> list[Path]:
    return [page.with_name(f"{page.name}.jinja") for page in documents(root)]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project with a template and the figures that it quotes."""
    (tmp_path / "docs/figures").mkdir(parents=True)
    (tmp_path / "README.md.jinja").write_text("Off by {{ some_study.off_m | to('.2f') }} m.\n")
    write_figures(tmp_path, {"off_m": 0.123})
    return tmp_path


def write_figures(project: Path, figures: dict[str, object]) -> None:
    text = json.dumps({"command": "", "version": "", "figures": figures})
    (project / "docs/figures/some-study.json").write_text(text)


def test_a_figure_that_changes_changes_its_page(project: Path) -> None:
    (text,) = documents(project).values()
    assert text.startswith("<!-- Made of README.md.jinja ")
    assert text.endswith("-->\nOff by 0.12 m.\n")
    write_figures(project, {"off_m": -0.126})
    assert "Off by \u22120.13 m." in documents(project)[project / "README.md"]
    write_figures(project, {"off_m": None})
    assert "Off by \u2013 m." in documents(project)[project / "README.md"]


def test_a_figure_that_is_not_there_is_an_error(project: Path) -> None:
    write_figures(project, {})
    with pytest.raises(UndefinedError, match="off_m"):
        documents(project)


def test_pages_are_written(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(project)
    (project / "README.md").write_text("Off by 0.11 m, by hand.\n")
    assert main(["documents"]) == 0
    assert (project / "README.md").read_text("utf-8") == documents(project)[project / "README.md"]


def test_a_table_keeps_what_it_prints(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table({"kind": "<6", "share": ".0f", "found": ".2f"}, keys=2)
    table.row("disc", 20.0, 0.123456)
    table.row("disc", 40.0, 0.5)
    assert capsys.readouterr().out.splitlines() == [
        "| kind   | share | found |",
        "| ------ | ----- | ----- |",
        "| disc   |    20 |  0.12 |",
        "| disc   |    40 |  0.50 |",
    ]
    assert table.figures == {"disc": {"20": {"found": 0.123456}, "40": {"found": 0.5}}}


def test_programs_give_the_numbers_of_their_files(
    project_root: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(project_root)
    file, truth = tmp_path / "out.json", "images/m/truth.csv"
    shutil.copy(project_root / truth, tmp_path)
    score = f"groundtruth score {truth} {truth} --json @/score.json"
    assert main(["programs", score, "--figures", str(file)]) == 0
    kept = json.loads(file.read_text())
    assert kept["command"] == f"python -m tools.evaluation programs '{score}'"
    assert kept["figures"]["score"]["position_mean_m"] == 0.0
    assert main(["programs", "groundtruth score none.csv none.csv"]) == 1


def test_numbers_alone_are_kept() -> None:
    content = {"a": 1, "b": {"c": 0.5, "d": "text"}, "e": [1, 2], "f": None}
    assert numbers_in(content) == {"a": 1, "b": {"c": 0.5}}
