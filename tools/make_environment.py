"""Make the project's virtual environment, unless it already stands and fits.

Uses nothing but the standard library, so that any Python 3.11 or newer can run it:

    python3 tools/make_environment.py .venv
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def main() -> int:
    """Make the environment named on the command line; 0 when it is ready."""
    # Spoken by whatever python3 is there: it may be older than the project's code.
    if sys.version_info < (3, 11):  # noqa: UP036
        found = ".".join(str(part) for part in sys.version_info[:3])
        print(
            f"error: python3 is {found}: expected 3.11 or newer (make PYTHON=...)", file=sys.stderr
        )
        return 1
    environment = Path(sys.argv[1]).resolve()
    stamp = environment / "ready"
    wanted = _fingerprint(environment)
    if stamp.is_file() and stamp.read_text() == wanted:
        return 0
    print(f"setting up {environment.name} (once; a few minutes on a slow connection)", flush=True)
    shutil.rmtree(environment, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
    pip = [str(environment / "bin" / "python"), "-m", "pip", "--disable-pip-version-check"]
    finished = subprocess.run(
        [*pip, "install", "--quiet", "--editable", f"{ROOT}[dev]"], check=False
    )
    if finished.returncode != 0:
        print("error: the packages could not be installed (see above)", file=sys.stderr)
        return 1
    stamp.write_text(wanted)
    return 0


def _fingerprint(environment: Path) -> str:
    """What the environment depends on: its place, the interpreter and the declared packages."""
    parts = [str(environment), sys.executable, sys.version, (ROOT / "pyproject.toml").read_text()]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
