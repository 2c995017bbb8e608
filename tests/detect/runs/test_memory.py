"""Memory does not grow with the run: neither the workers' nor that of what hands out the frames."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from camera import Camera, write_camera

_REDUCED = 8

#: Prints the peaks of this process and of the largest of its own, in MiB. What `getrusage` has of
#: a process begins with the peak of the one that started it, which is no matter for the workers.
PROGRAM = """
import re, resource, sys
from pathlib import Path
from detect.cli import main

if __name__ == "__main__":
    code = main(sys.argv[1:])
    (own,) = re.findall(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())
    largest = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    print(code, int(own) / 1024, largest / 1024)
"""


def long_run(folder: Path, source: Path, camera: Camera, frames: int) -> Path:
    """A run of small images: a few frames of the demo run, reduced, over and over."""
    k = _REDUCED
    small = replace(
        camera, width=camera.width // k, height=camera.height // k, scale_x=camera.scale_x / k,
        scale_y=camera.scale_y / k, offset_x=camera.offset_x / k, offset_y=camera.offset_y / k,
    )  # fmt: skip
    images = folder / "images"
    images.mkdir(parents=True)
    write_camera(small, folder / f"{folder.name}.cam")
    contents = []
    for number in range(4):
        grey = cv2.imread(str(source / "images" / f"e.{number:04d}.jpg"), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        reduced = cv2.resize(grey, (small.width, small.height), interpolation=cv2.INTER_AREA)
        contents.append(folder / f"{number}.png")
        assert cv2.imwrite(str(contents[-1]), reduced)
    with (folder / f"{folder.name}.txt").open("w") as steps:
        for number in range(frames):
            os.link(contents[number % 4], images / f"m.{number:06d}.png")
            steps.write(f"STEP m.{number:06d} 0.25 0 0.01 1e-5 0 1e-5 0 0 1e-4\n")
    return folder


def peaks_mib(arguments: list[str], program: Path, expected: int = 0) -> tuple[float, float]:
    """Peak memory of the command and of its largest worker."""
    root = Path(__file__).resolve().parents[3]
    program.write_text(PROGRAM)
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, str(program), *arguments, "--force"],
            env={**os.environ, "PYTHONPATH": str(root)},
            capture_output=True,
            text=True,
            check=True,
        )
        if "compiling kernels" not in done.stderr:
            break  # it takes more memory than any run
    code, own, largest = done.stdout.splitlines()[-1].split()
    assert int(code) == expected, done.stderr
    return float(own), float(largest)


@pytest.mark.skipif(sys.platform != "linux", reason="counts memory in Linux's units")
def test_the_peak_is_the_program_s_own(tmp_path: Path) -> None:
    """Not that of the tests' process, which started it."""
    block = bytearray(b"1") * (400 << 20)
    own, _ = peaks_mib(["circles", str(tmp_path)], tmp_path / "program.py", expected=1)
    assert len(block) >> 20 == 400
    assert 5.0 < own < 300.0


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="counts memory in Linux's units")
def test_memory_is_flat(project_root: Path, published_camera: Camera, tmp_path: Path) -> None:
    source = project_root / "images" / "e"
    peaks = []
    for frames in (100, 2000):
        run = long_run(tmp_path / f"run{frames}", source, published_camera, frames)
        peaks.append(peaks_mib(["all", str(run), "--jobs", "2"], tmp_path / "program.py"))
    (own, worker), (own_long, worker_long) = peaks
    assert 50.0 < worker_long < 300.0
    # 1900 frames that left 5 kB each, as much as their rows, would be seen.
    assert own_long - own < 9.0
    assert worker_long - worker < 9.0
