"""Pages that quote figures are those that their templates and the figures' files make."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
from importlib import import_module
from pathlib import Path

import pytest
from jinja2 import UndefinedError

from tools.benchmark.__main__ import Benchmark
from tools.evaluation.__main__ import STUDIES, main
from tools.evaluation.figures import Study, documents, numbers_in
from tools.evaluation.tables import Table
from tools.soak.__main__ import Soak

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
    lines = make(project_root, "commands").stdout.splitlines()
    commands = dict(line.split(": ", 1) for line in lines)
    assert commands.keys() == names - {"left-out"}
    for name, command in commands.items():
        recorded = json.loads((folder / f"{name}.json").read_text("utf-8"))["command"]
        assert shlex.split(command) == shlex.split(recorded)
        assert name == "speed" or command.split()[3] in STUDIES.keys() - _OTHERS


def make(root: Path, *words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """What `make -f tools/evaluation/figures.mk` does, whatever the environment says."""
    file, path = root / "tools/evaluation/figures.mk", {"PATH": os.environ["PATH"]}
    return subprocess.run(
        ["make", "-f", file, *words], cwd=cwd or root, env=path, capture_output=True, text=True,
        check=False,
    )  # fmt: skip


def test_figures_are_made_one_by_one_and_those_of_a_failed_study_are_not_kept(
    project_root: Path, tmp_path: Path
) -> None:
    program = tmp_path / "python"
    program.write_text(
        "#!/bin/sh\nfor file; do :; done; echo {} > $file\n"
        "mkdir alone || touch together; sleep 0.2; rmdir alone\n"
        "case $file in *demo*) exit 1;; esac\n"
    )
    program.chmod(0o755)
    (tmp_path / "docs/figures").mkdir(parents=True)
    # Both are wanted, whatever becomes of the other, as far as possible at once.
    words = ("-k", "-j2", f"BIN={tmp_path}", "FIGURES=accuracy demo")
    assert make(project_root, *words, cwd=tmp_path).returncode != 0
    assert not (tmp_path / "together").exists()
    assert [path.name for path in (tmp_path / "build/figures").glob("*.json")] == ["accuracy.json"]
    assert [path.name for path in (tmp_path / "docs/figures").iterdir()] == ["accuracy.json"]


@pytest.mark.parametrize("file", ["images/e/e.cam", "docs/figures/down.cam", "detect/circles.py"])
def test_figures_are_made_again_where_what_they_depend_on_is_newer(
    project_root: Path, tmp_path: Path, file: str
) -> None:
    made = tmp_path / "accuracy.json"
    made.touch()
    words = ("-q", f"MADE={tmp_path}", str(made))
    assert make(project_root, *words).returncode == 0
    assert make(project_root, "-W", file, *words).returncode == 1


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
    for flag in (["--figures", str(file)], [f"--figures={file}"]):
        assert main(["programs", score, *flag]) == 0
        kept = json.loads(file.read_text())
        assert kept["command"] == f"python -m tools.evaluation programs '{score}'"
        assert kept["figures"]["score"]["position_mean_m"] == 0.0
    assert main(["programs", "groundtruth score none.csv none.csv"]) == 1


def test_a_wrong_flag_of_a_study_is_quoted(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["programs", "tools.evaluation accuracy --disks 3"]) == 1
    assert "ended with 2: " in (error := capsys.readouterr().err)
    assert "--disks" in error


@pytest.mark.parametrize("kind", [Benchmark, Soak])
def test_no_flags_are_not_those_of_the_process(
    kind: type[Study], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kind, "measure", lambda _: {})
    monkeypatch.setattr("sys.argv", ["pytest", "--not-a-flag"])
    assert import_module(kind.__module__).main([]) == 0
    with pytest.raises(SystemExit):
        import_module(kind.__module__).main()


def test_numbers_alone_are_kept() -> None:
    content = {"a": 1, "b": {"c": 0.5, "d": "text"}, "e": [1, 2], "f": None}
    assert numbers_in(content) == {"a": 1, "b": {"c": 0.5}}
