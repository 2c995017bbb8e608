"""Make the project's virtual environment, unless it exists and is up to date.

If `requirements/lock.txt` was made for this kind of machine, exactly the packages that it names
are installed, each checked against its hash; elsewhere, what `pyproject.toml` allows. Uses nothing
but the standard library, so that any Python 3.11 or newer can run it:

    python3 tools/make_environment.py .venv
"""

from __future__ import annotations

import hashlib
import platform
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOCK = ROOT / "requirements" / "lock.txt"
#: What the lock file was made and tested on.
LOCKED_FOR = ("Linux", "x86_64", (3, 11))
_WRONG_HASH = "DO NOT MATCH THE HASHES"


def main() -> None:
    """Make the environment named on the command line; ends with 1 if that fails."""
    # Whatever python3 is installed runs this: it may be older than the project's code.
    if sys.version_info < (3, 11):  # noqa: UP036
        found = ".".join(str(part) for part in sys.version_info[:3])
        sys.exit(f"error: python3 is {found}: expected 3.11 or newer (make PYTHON=...)")
    environment = Path(sys.argv[1]).absolute()
    if environment.is_symlink():
        sys.exit(
            f"error: {environment} is a link to {environment.resolve()}: expected a folder of "
            "this checkout: what is made anew there would be missing elsewhere"
        )
    environment = environment.resolve()
    stamp = environment / "ready"
    wanted = _fingerprint(environment)
    if stamp.is_file() and stamp.read_text() == wanted:
        return
    print(f"setting up {environment.name} (once; a few minutes on a slow connection)", flush=True)
    if not _installed(environment):
        sys.exit("error: the packages could not be installed (see above)")
    stamp.write_text(wanted)


def _installed(environment: Path) -> bool:
    """Install the locked packages or, if that is impossible, what the project allows."""
    here = (platform.system(), platform.machine(), sys.version_info[:2])
    if not LOCK.is_file() or here != LOCKED_FOR:
        system, machine, (major, minor) = LOCKED_FOR
        why = f"the lock file is for Python {major}.{minor} on {system} {machine}"
        return _installed_unlocked(environment, why)
    pip = _new_environment(environment)
    # Compiled below, by all cores.
    locked = subprocess.run(
        [
            *pip, "install", "--quiet", "--no-compile", "--require-hashes", "--no-deps",
            "--requirement", str(LOCK),
        ],
        check=False, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    if locked.returncode == 0:
        # All that it needs is there, including setuptools: nothing is fetched for the build.
        own = [*pip, "install", "--quiet", "--no-build-isolation", "--editable", f"{ROOT}[dev]"]
        if subprocess.run(own, check=False).returncode != 0:
            return False
        _compile_modules(environment)
        return True
    sys.stderr.write(locked.stderr)
    if _WRONG_HASH in locked.stderr:
        # Somebody distributes other files under the same names: nothing from there is installed.
        return False
    return _installed_unlocked(environment, "some of the locked packages are not available here")


def _compile_modules(environment: Path) -> None:
    """Compile what is installed, even if Python is set not to keep what it compiles.

    Otherwise every process would compile all of its imports again: a third of a second for
    `detect`, and for each of its workers. The packages' own tests, a quarter of it, are left out.
    """
    command = [str(environment / "bin" / "python"), "-m", "compileall", "-qq", "-j", "0"]
    command += ["-x", r"site-packages/.*/tests?/"]
    # Some files are templates, or for other versions of Python, and no modules here.
    subprocess.run([*command, str(environment)], check=False)


def _installed_unlocked(environment: Path, why: str) -> bool:
    print(f"{why}: installing what pyproject.toml allows, without hashes", flush=True)
    own = [*_new_environment(environment), "install", "--quiet", "--editable", f"{ROOT}[dev]"]
    return subprocess.run(own, check=False).returncode == 0


def _new_environment(environment: Path) -> list[str]:
    """Make a new, empty environment; returns the command of its pip."""
    shutil.rmtree(environment, ignore_errors=True)
    subprocess.run([_interpreter(), "-m", "venv", str(environment)], check=True)
    return [str(environment / "bin" / "python"), "-m", "pip", "--disable-pip-version-check"]


def _interpreter() -> str:
    """The interpreter outside of environments: the active one may be the one that is replaced."""
    if sys.prefix == sys.base_prefix:
        return str(Path(sys.executable).resolve())
    found = Path(sys.base_prefix) / "bin" / f"python{sys.version_info[0]}.{sys.version_info[1]}"
    return str(found.resolve())


def _fingerprint(environment: Path) -> str:
    """What the environment depends on: its place, the interpreter and the declared packages."""
    files = [path.read_text() for path in (ROOT / "pyproject.toml", LOCK) if path.is_file()]
    parts = [str(environment), _interpreter(), sys.version, *files]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


if __name__ == "__main__":
    main()
