"""Build wheel and source distribution, install each into an empty environment, and use it there.

    make package

The commands of both are tried on the demo images from outside of the checkout. Prints sizes and
times; ends with 1 if anything fails. Dependencies are fetched as `pip` is configured.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import venv
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Commands that are tried, in a folder with copies of `images/e` and `images/m`.
COMMANDS = (
    "redetect --help",
    "redetect demo -o demo",
    "detect --help",
    "detect explain e/images/e.0000.jpg --at 258 111",
    "detect circles e",
    "detect lines e",
    "detect compare e",
    "detect draw e --every 40 -o drawn",
    "detect report e -o e.html",
    "detect markers m/a",
    "detect markers m/b",
    "groundtruth poses m -o poses.csv",
    "groundtruth score poses.csv m/truth.csv",
    "camera convert e/e.cam e.opencv.yaml",
    "slam map e --circles --lines -o map",
    "slam localize e --map map/map.csv -o localized",
    "slam export e --to g2o -o e.g2o",
)


def main() -> int:
    """Build, install, use; 0 if all went well."""
    with tempfile.TemporaryDirectory(prefix="redetect-package-") as name:
        work = Path(name)
        started = time.perf_counter()
        _run([sys.executable, "-m", "build", "--outdir", str(work / "dist"), str(ROOT)], ROOT)
        print(f"built in {time.perf_counter() - started:.0f} s")
        for archive in sorted((work / "dist").iterdir(), reverse=True):
            print(f"{archive.name}: {archive.stat().st_size / 1024:.0f} KiB")
            _try(archive, work / archive.suffix.strip("."))
        _try_tests(work)
    return 0


def _try(archive: Path, folder: Path) -> None:
    """Install one archive into an environment of its own and run the commands there."""
    started = time.perf_counter()
    venv.create(folder / "venv", with_pip=True)
    binaries = folder / "venv" / "bin"
    pip = [str(binaries / "python"), "-m", "pip", "--disable-pip-version-check"]
    _run([*pip, "install", "--quiet", str(archive)], folder)
    print(f"  installed in {time.perf_counter() - started:.0f} s")
    shutil.copytree(ROOT / "images", folder / "images")
    # Kernels are compiled again, as after a new installation.
    here = {**os.environ, "REDETECT_CACHE": str(folder / "tables")}
    for command in COMMANDS:
        program, *words = command.split()
        started = time.perf_counter()
        _run([str(binaries / program), *words], folder / "images", here)
        print(f"  {command}: {time.perf_counter() - started:.1f} s")


def _try_tests(work: Path) -> None:
    """Run some tests of the source distribution in its own folder, in this environment."""
    (archive,) = (work / "dist").glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        opened.extractall(work / "source", filter="data")
    (folder,) = (work / "source").iterdir()
    tests = [f"tests/{name}" for name in ("camera", "landmarks", "lut", "storage")]
    _run([sys.executable, "-m", "pytest", "-q", "-m", "not long", *tests], folder)
    print(f"  {', '.join(tests)} pass from the source distribution")


def _run(command: Sequence[str], folder: Path, environment: dict[str, str] | None = None) -> None:
    """Run a command quietly; if it fails, print its output and end."""
    done = subprocess.run(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        print(done.stdout)
        sys.exit(f"error: {' '.join(command)} ended with {done.returncode}")


if __name__ == "__main__":
    sys.exit(main())
