"""The environment that `make` sets up: never that of another checkout, never made anew in vain."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def test_an_environment_of_another_checkout_is_left_alone(
    tmp_path: Path, project_root: Path
) -> None:
    other, link = tmp_path / "other", tmp_path / "link"
    other.mkdir()
    (other / "kept").touch()
    link.symlink_to(other)
    process = subprocess.run(
        [sys.executable, project_root / "tools" / "make_environment.py", link],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert process.returncode == 1
    assert "is a link to" in process.stderr
    assert [path.name for path in other.iterdir()] == ["kept"]


def test_an_active_environment_is_the_same_as_its_interpreter(project_root: Path) -> None:
    """Else `make` in an activated environment would make it anew."""
    program = "from tools.make_environment import _fingerprint; from pathlib import Path; "
    program += "print(_fingerprint(Path('/e')))"
    own = Path(sys.base_prefix) / "bin" / f"python{sys.version_info[0]}.{sys.version_info[1]}"
    said = {
        subprocess.run(
            [python, "-c", program], cwd=project_root, capture_output=True, text=True, check=True
        ).stdout
        for python in (sys.executable, own)
    }
    assert len(said) == 1
