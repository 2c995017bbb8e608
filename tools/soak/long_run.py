"""A run of any length, monitored while it is processed."""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import psutil  # type: ignore[import-untyped,unused-ignore]

from tools.evaluation.figures import StudyError

#: Throughput is compared between these shares of the run: before and after them, processes start
#: and files are renamed.
_FIRST, _LAST = (0.01, 0.11), (0.89, 0.99)
#: The processes are examined each time such a share of the run is done, whatever its duration.
_SAMPLE_EVERY = 0.004
_POLL_EVERY_S = 0.02
_DECODINGS = 5
_MIB = 1 << 20

#: Limits of the growth from a tenth of the run to its end, and of the change of the throughput.
MOST_GROWTH_MIB = 8.0
MOST_SLOWER = 0.05


class ProcessState(NamedTuple):
    """State of a process."""

    pid: int
    resident_bytes: int  # Private and shared memory in use.
    descriptors: int  # Open files, pipes and the like.
    processor_s: float  # Processor time so far.


def family(pid: int) -> list[ProcessState]:
    """A process, first, and all its descendants, except those that have just ended."""
    found = []
    with suppress(psutil.Error):
        first = psutil.Process(pid)
        for process in [first, *first.children(recursive=True)]:
            with suppress(psutil.Error), process.oneshot():
                times = process.cpu_times()
                state = process.memory_info().rss, process.num_fds(), times.user + times.system
                found.append(ProcessState(process.pid, *state))
    return found


class _Sample(NamedTuple):
    time_s: float
    frames: int
    processor_s: float  # Of all processes.
    resident_mib: float  # Of the process that dispatches the frames.
    worker_mib: float  # Of the largest other one.
    descriptors: int  # Of all processes.
    processes: int
    decoding_s: float  # Processor time for decoding an image at this moment.


@dataclass(frozen=True)
class SoakResult:
    """Result of a long run."""

    frames: int
    jobs: int
    duration_s: float
    frames_per_s: tuple[float, float]  # In the first and the last tenth, by wall clock.
    decoding_ms: tuple[float, float]
    """Processor time for decoding one of the images meanwhile, in this process: the speed of the
    machine under its other load."""
    decodings_per_frame: tuple[float, float]
    """Processor time of all processes per frame, in units of that: this is compared."""
    resident_mib: tuple[float, ...]
    """Memory of the process that dispatches the frames, and of the largest worker, at 10, 50, 90
    and 99 % of the run."""
    worker_mib: tuple[float, ...]
    descriptors: tuple[int, ...]
    """Open in all processes, at the same moments; the least of nine samples around each."""
    processes: int  # Largest number of processes.

    def unmet(self) -> list[str]:
        """The failed checks, a sentence each."""
        found = []
        for what, values in (("memory", self.resident_mib), ("a worker's memory", self.worker_mib)):
            if values[-1] - values[0] > MOST_GROWTH_MIB:
                found.append(f"{what} grew by {values[-1] - values[0]:.1f} MiB")
        if self.descriptors[-1] > self.descriptors[0]:
            found.append(f"{self.descriptors[-1] - self.descriptors[0]} descriptors stayed open")
        first, last = self.decodings_per_frame
        if last * (1.0 - MOST_SLOWER) > first:
            found.append(f"the last tenth was {1.0 - first / last:.1%} slower than the first")
        return found


def soak(run: Path, output: Path, frames: int, jobs: int) -> SoakResult:
    """Process a run by `detect all`, and monitor its processes."""
    output.mkdir()
    arguments = ["all", str(run), "-o", str(output), "--jobs", str(jobs)]
    begin_s = time.monotonic()
    with subprocess.Popen(
        [sys.executable, "-m", "detect", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            image = min((run / "images").iterdir()).read_bytes()
            least = int(_SAMPLE_EVERY * frames)
            samples = _samples_of(process, output / ".detected.journal", image, least)
            _, said = process.communicate()
        except BaseException:
            process.kill()
            raise
    if process.returncode != 0:
        raise StudyError(f"detect ended with {process.returncode}: {said.strip()[-500:]}")
    return _result(samples, frames, jobs, time.monotonic() - begin_s)


def _samples_of(
    process: subprocess.Popen[str], journal: Path, image: bytes, least: int
) -> list[_Sample]:
    """Sample the processes whenever enough further frames are in the journal."""
    samples: list[_Sample] = []
    lines, place = -1, 0  # the first line is not a frame
    while process.poll() is None:
        content = b""
        with suppress(OSError), journal.open("rb") as stream:
            stream.seek(place)
            content = stream.read()
        lines += content.count(b"\n")
        place += len(content)
        if lines - (samples[-1].frames if samples else 0) > least and (own := family(process.pid)):
            resident = [state.resident_bytes / _MIB for state in own]
            samples.append(
                _Sample(
                    time.monotonic(), lines, sum(state.processor_s for state in own), resident[0],
                    max(resident[1:], default=0.0), sum(state.descriptors for state in own),
                    len(own), _decoding_s(image),
                )
            )  # fmt: skip
        time.sleep(_POLL_EVERY_S)
    return samples


def _decoding_s(image: bytes) -> float:
    """Processor time for decoding an image; the first of several is ignored."""
    content = np.frombuffer(image, np.uint8)
    times_s = []
    for _ in range(_DECODINGS):
        begin_s = time.thread_time()
        cv2.imdecode(content, cv2.IMREAD_GRAYSCALE)
        times_s.append(time.thread_time() - begin_s)
    return float(np.median(times_s[1:]))


def _result(samples: list[_Sample], frames: int, jobs: int, duration_s: float) -> SoakResult:
    done = np.array([sample.frames for sample in samples], float)
    if len(samples) < 40 or np.count_nonzero(done <= _FIRST[1] * frames) < 4:
        raise StudyError(f"{frames} frames: too few to be sampled, expected more")
    columns = _Sample(*np.array(samples, float).T)

    def per_frame(values: Any, share: tuple[float, float]) -> float:
        begin, end = np.interp([share[0] * frames, share[1] * frames], done, values)
        return float((end - begin) / ((share[1] - share[0]) * frames))

    def decoding_s(share: tuple[float, float]) -> float:
        meanwhile = (done >= share[0] * frames) & (done <= share[1] * frames)
        return float(np.mean(np.asarray(columns.decoding_s)[meanwhile]))

    decoding = decoding_s(_FIRST), decoding_s(_LAST)
    computed = [per_frame(columns.processor_s, share) for share in (_FIRST, _LAST)]
    moments = [int(np.argmax(done >= share * frames)) for share in (0.1, 0.5, 0.9)]
    moments.append(int(np.argmax(done >= min(0.99 * frames, done[-1]))))
    return SoakResult(
        frames=frames,
        jobs=jobs,
        duration_s=duration_s,
        frames_per_s=(
            1.0 / per_frame(columns.time_s, _FIRST),
            1.0 / per_frame(columns.time_s, _LAST),
        ),
        decoding_ms=(1e3 * decoding[0], 1e3 * decoding[1]),
        decodings_per_frame=(computed[0] / decoding[0], computed[1] / decoding[1]),
        resident_mib=tuple(samples[moment].resident_mib for moment in moments),
        worker_mib=tuple(samples[moment].worker_mib for moment in moments),
        # The least around a moment, since an image may be read just then.
        descriptors=tuple(
            min(sample.descriptors for sample in samples[max(moment - 4, 0) : moment + 5])
            for moment in moments
        ),
        processes=max(sample.processes for sample in samples),
    )
