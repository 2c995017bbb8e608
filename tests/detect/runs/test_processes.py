"""Worker processes: how they begin, and what the process that has them need not do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from detect.cli import main
from detect.runs.plan import FramePlan, Job
from detect.runs.stream import detect_run
from detect.runs.workers import local_workers
from detect.settings import CircleSettings
from detect.sources.opening import open_run
from lut import TableError
from tests.detect.commands import Captured, output_of

# -- the process that has them --------------------------------------------------------------


@pytest.mark.long
def test_who_has_others_work_loads_no_compiler(small_run: Path) -> None:
    """It would begin half a second later."""
    said = output_of(
        "import sys\n"
        "from detect.cli import main\n"
        "if __name__ == '__main__':\n"
        f"    code = main(['circles', {str(small_run)!r}, '--tilt', 'none', '--jobs', '2'])\n"
        "    heavy = {'numba', 'scipy', 'skimage', 'lut'} & set(sys.modules)\n"
        "    print('exit', code, 'heavy', sorted(heavy))\n"
    )
    assert said.splitlines()[-1] == "exit 0 heavy []"


def test_workers_load_no_command_line() -> None:
    """They import the program before they know what for."""
    said = output_of(
        "import sys, detect.__main__; print({'tyro', 'detect.cli', 'numpy'} & set(sys.modules))"
    )
    assert said == "set()\n"


def test_an_interrupt_while_the_program_is_imported() -> None:
    said = output_of(
        "import sys\n"
        "from detect.__main__ import main\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'detect.cli':\n"
        "            raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupting())\n"
        "print(main())\n"
    )
    assert said == "130\n"


# -- what they begin with -----------------------------------------------------------------------


@pytest.mark.long
def test_one_of_them_makes_the_tables(
    small_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Captured
) -> None:
    """The others wait for the cache, and find there what a process alone would have made."""
    arguments = ["all", str(small_run), "-o"]
    assert main([*arguments, str(tmp_path / "one")]) == 0
    monkeypatch.setenv("REDETECT_CACHE", str(tmp_path / "tables"))
    capfd.readouterr()
    assert main([*arguments, str(tmp_path / "two"), "--jobs", "2"]) == 0
    said = capfd.readouterr().err
    assert said.count("computing the table of votes") == 1
    assert said.count("computing the table of verticals") == 1
    for kind in ("circles", "lines", "tilt"):
        one, two = (tmp_path / name / f"detected.{kind}" for name in ("one", "two"))
        assert one.read_bytes() == two.read_bytes()


@pytest.mark.long
def test_workers_tell_what_is_wrong_with_the_tables(small_run: Path) -> None:
    """As the process itself would; and nothing is left of what was begun."""
    run = open_run(small_run)
    rows = run.camera.robot_from_camera
    under = replace(run.camera, robot_from_camera=(*rows[:2], (*rows[2][:3], -1.5)))
    before = sorted(small_run.iterdir())
    with pytest.raises(TableError, match=r"the camera is -1\.5 m above the floor: expected more"):
        detect_run(
            Job(
                replace(run, camera=under),
                FramePlan(under, circles=CircleSettings()),
                {"circles": small_run / "out.circles"},
            ),
            local_workers(2),
        )
    assert sorted(small_run.iterdir()) == before
