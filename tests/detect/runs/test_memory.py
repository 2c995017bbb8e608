"""Memory does not grow with a video or a bag, of the workers or of what hands out the frames.

That of a folder: `tests/tools/soak`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera, write_camera
from tests.detect.forked_runs import started
from tests.detect.recordings import images_of, write_video
from tools.benchmark.material import scaled_camera
from tools.ros_bags import Ros, Said

Images = Sequence[NDArray[np.uint8]]

_REDUCED = 6
_FRAMES = (100, 1000)

#: Detects in runs, one after the other, and prints the peaks of this process and of the largest of
#: its own after each, in MiB. What `getrusage` has of a process begins with the peak of the one
#: that started it, which is no matter for the workers.
PROGRAM = """
import re, resource, sys
from pathlib import Path
from detect.cli import main
from tests.pictures import read_grey

if __name__ == "__main__":
    jobs, *runs = sys.argv[1:]
    for run in runs:
        assert main(["all", run, "--jobs", jobs, "--force"]) == 0
        (own,) = re.findall(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())
        largest = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        print("MiB:", int(own) / 1024, largest / 1024)
"""


def as_a_video(folder: Path, images: Images, count: int) -> Path:
    return write_video(folder / f"{count}.avi", [images[k % len(images)] for k in range(count)])


def in_a_bag(folder: Path, images: Images, count: int) -> Path:
    """With odometry beside its images."""
    pytest.importorskip("rosbags", reason="the extra [bags] is not installed")
    ros, said = Ros(), []
    for k in range(count):
        time_s = 100.0 + 0.1 * k
        pose = ros.odometry(0.2 * k, 0.0, 0.0, time_s, np.zeros((3, 3)))
        image = ros.image(images[k % len(images)], "mono8", time_s)
        said += [Said("/odom", time_s, pose), Said("/image", time_s, image)]
    return ros.write(folder / str(count), said)


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="counts memory in Linux's units")
@pytest.mark.parametrize(("record", "jobs"), [(as_a_video, "2"), (in_a_bag, "1")])
def test_memory_is_flat(
    project_root: Path,
    published_camera: Camera,
    tmp_path: Path,
    record: Callable[[Path, Images, int], Path],
    jobs: str,
) -> None:
    small = scaled_camera(published_camera, 1 / _REDUCED)
    write_camera(small, tmp_path / "small.cam")
    size = (small.width, small.height)
    images = [
        np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        for image in images_of(project_root / "images" / "e")[:4]
    ]
    short, long = (str(record(tmp_path, images, count)) for count in _FRAMES)
    # Workers begin with the memory of this process, which the first run of all increases.
    runs = [short, short, long]
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    for _ in range(3):
        with started([str(program), jobs, *runs]) as process:
            said, errors = process.communicate()
        assert process.returncode == 0, errors
        if "compiling kernels" not in errors:
            break  # it takes more memory than any run
    peaks = [line.split()[1:] for line in said.splitlines() if line.startswith("MiB:")]
    _, (own, worker), (own_long, worker_long) = np.array(peaks, float)
    assert jobs == "1" or 50.0 < worker_long < 350.0
    # 900 frames that left 7 kB each, little more than an image, would be seen.
    assert own_long - own < 6.0
    assert worker_long - worker < 6.0
