"""Kernels loaded from the cache: what they compute, and what is not imported for that."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

KERNELS = '''
import numpy as np
from numba import njit

@njit(cache=True, error_model="numpy")
def spread(values):
    """Allocates, sums up, and raises: what is loaded has constants and parts of Numba's own."""
    if len(values) < 2:
        raise ValueError("expected two values or more")
    off = np.empty(len(values))
    off[:] = values
    off -= values.sum() / len(values)
    return np.sqrt((off * off).sum() / len(values))

@njit(cache=True, error_model="numpy")
def spread_of_two(values):
    return spread(values) + spread(2.0 * values)
'''

PROGRAM = """
import sys
from storage.kernel_loading import load_kernels_alone
load_kernels_alone()
import numpy as np
from kernels import spread, spread_of_two
print(spread(np.array([1.0, 2.0, 3.0, 4.0])))
print("numba.np.arraymath" in sys.modules or "scipy.linalg" in sys.modules)
try:
    spread(np.array([1.0]))
except ValueError as error:
    print(error)
if "more" in sys.argv:
    print(spread_of_two(np.array([1.0, 2.0, 3.0, 4.0])))  # compiled round one that was loaded
    print(spread(np.array([1, 2, 3, 4])))  # another signature
"""


WAITING_PROGRAM = """
import subprocess, sys
from storage.kernel_loading import waiting_before_compiling

def another_compiles():
    waited.append(True)
    subprocess.run([sys.executable, "-c", sys.argv[1]], stdout=subprocess.DEVNULL, check=True)

waited = []
with waiting_before_compiling(another_compiles) as waits:
    from kernels import doubled
    print(waits, doubled(1.0), len(waited))
print(sum(doubled.stats.cache_hits.values()), sum(doubled.stats.cache_misses.values()))
doubled(1)  # afterwards nobody is waited for
print(len(waited), sum(doubled.stats.cache_misses.values()))
"""


KILLED_PROGRAM = """
import os, sys
from storage.kernel_loading import load_kernels_alone
load_kernels_alone()
from numba.core.caching import IndexDataCacheFile
from kernels import doubled
IndexDataCacheFile._save_data = lambda *_: os._exit(0)  # as if killed
doubled(1.0)
"""

MANY_KERNELS = "from numba import njit\n\n" + "".join(
    f"@njit(cache=True)\ndef times_{k}(x):\n    return {k}.0 * x\n\n" for k in range(12)
)

MANY_PROGRAM = """
from storage.kernel_loading import load_kernels_alone
load_kernels_alone()
import kernels
found = [getattr(kernels, f"times_{k}") for k in range(12)]
print([times(2.0) for times in found])
print(sum(sum(times.stats.cache_misses.values()) for times in found))
"""

DOUBLED = "from numba import njit\n\n@njit(cache=True)\ndef doubled(x):\n    return {} * x\n"


def started(folder: Path, *arguments: str, program: str = PROGRAM) -> subprocess.Popen[str]:
    root = Path(__file__).resolve().parents[2]
    return subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(root), str(folder)]),
            "NUMBA_CACHE_DIR": str(folder / "cache"),
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process: subprocess.Popen[str]) -> list[str]:
    out, err = process.communicate()
    assert (process.returncode, err) == (0, "")
    return out.splitlines()


def said(folder: Path, *arguments: str, program: str = PROGRAM) -> list[str]:
    return ended(started(folder, *arguments, program=program))


@pytest.mark.long
def test_loaded_kernels_need_no_compiler_and_are_the_same(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS)
    deviation, refused = str(1.25**0.5), "expected two values or more"
    assert said(tmp_path) == [deviation, "True", refused]  # compiled
    assert said(tmp_path) == [deviation, "False", refused]  # loaded
    both = [str(3.0 * 1.25**0.5), deviation]
    assert said(tmp_path, "more") == [deviation, "False", refused, *both]  # compiled round it


@pytest.mark.long
def test_what_another_process_compiles_meanwhile_is_loaded(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(DOUBLED.format("3.0"))
    another = "from kernels import doubled; doubled(1.0)"
    compiled_there = said(tmp_path, another, program=WAITING_PROGRAM)
    assert compiled_there == ["True 3.0 1", "1 0", "1 1"]
    cached = said(tmp_path, another, program=WAITING_PROGRAM)  # nothing to wait for
    assert cached == ["True 3.0 0", "1 0", "0 0"]


@pytest.mark.long
def test_what_two_compile_at_once_is_loaded_by_a_third(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(MANY_KERNELS)
    products = str([2.0 * k for k in range(12)])
    both = [started(tmp_path, program=MANY_PROGRAM) for _ in range(2)]
    found = [ended(process) for process in both]
    assert [line for line, _ in found] == [products] * 2
    assert max(int(compiled) for _, compiled in found) > 0
    line, compiled = said(tmp_path, program=MANY_PROGRAM)
    assert line == products
    # Of two variants of a kernel that are kept at the same moment, Numba may forget one.
    assert int(compiled) <= 1


def test_a_process_killed_while_it_keeps_a_kernel_vouches_for_no_earlier_one(
    tmp_path: Path,
) -> None:
    program = "from kernels import doubled; print(doubled(1.0))"
    (tmp_path / "kernels.py").write_text(DOUBLED.format("3.0"))
    assert said(tmp_path, program=program) == ["3.0"]
    (tmp_path / "kernels.py").write_text(DOUBLED.format("2.00"))
    said(tmp_path, program=KILLED_PROGRAM)
    assert [path.suffix for path in (tmp_path / "cache").rglob("*.nb?")] == [".nbi"]
    assert said(tmp_path, program=program) == ["2.0"]


PAIRED = """
from typing import NamedTuple
from numba import njit

class {name}(NamedTuple):
    first: float
    second: float

@njit(cache=True)
def total(pair):
    return pair.first + pair.second

def of(first, second):
    return total({name}(first, second))
"""


def test_an_index_of_an_earlier_version_with_other_classes_counts_as_empty(tmp_path: Path) -> None:
    program = (
        "from storage.kernel_loading import load_kernels_alone; load_kernels_alone()\n"
        "from kernels import of; print(of(1.0, 2.0))"
    )
    for name in ("Pair", "Couple"):
        (tmp_path / "kernels.py").write_text(PAIRED.format(name=name))
        assert said(tmp_path, program=program) == ["3.0"]


def test_a_numba_without_the_attributes_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    from numba.core import environment
    from numba.core.caching import Cache

    from storage.kernel_loading import load_kernels_alone

    own = Cache.load_overload
    monkeypatch.setattr(Cache, "load_overload", own)  # put back afterwards
    monkeypatch.delattr(environment, "lookup_environment")
    assert not load_kernels_alone.__wrapped__()
    assert Cache.load_overload is own
