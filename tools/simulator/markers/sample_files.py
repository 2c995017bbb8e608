"""Random frames as a folder of images with their truth."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from camera import format_camera, write_camera
from redetect.storage import write_whole
from tools.simulator.markers.sampling import (
    SampleFrame,
    SampleSettings,
    sample_cameras,
    sample_frame,
)


def write_samples(
    settings: SampleSettings,
    folder: Path,
    *,
    count: int,
    seed: int,
    jobs: int = 1,
    overwrite: bool = False,
    on_frame: Callable[[], None] | None = None,
) -> int:
    """Render random frames and write them as PNG files, with their calibrations and truth.

    Parameters
    ----------
    settings : SampleSettings
        What they are to be like.
    folder : Path
        Where they go: ``images/``, ``camera0.cam`` and so on, ``truth.json``.
    count, seed : int
        Frames 0 to count - 1 of that seed.
    jobs : int
        Processes that render.
    overwrite : bool
        Whether existing files may be replaced.
    on_frame : callable, optional
        Called after each frame.

    Returns
    -------
    int
        Number of markers in them.

    Raises
    ------
    redetect.storage.OutputExistsError
        If a file exists and `overwrite` is false.
    """
    import cv2

    (folder / "images").mkdir(parents=True, exist_ok=True)
    cameras = sample_cameras(settings.width, settings.height)
    for number, camera in enumerate(cameras):
        write_camera(camera, folder / f"camera{number}.cam", overwrite=overwrite)
    names = {format_camera(camera): f"camera{k}.cam" for k, camera in enumerate(cameras)}
    rows, markers = [], 0
    for frame in sample_frames(settings, seed, range(count), jobs):
        prefix = f"s{seed}.{frame.index:05d}"
        done, encoded = cv2.imencode(".png", frame.image)
        if not done:
            raise ValueError(f"{prefix}: could not be encoded")
        with write_whole(folder / "images" / f"{prefix}.png", overwrite=overwrite) as stream:
            stream.write(bytes(encoded))
        row: dict[str, Any] = {"image": prefix, "camera": names[format_camera(frame.camera)]}
        rows.append(json.dumps({**row, **frame.as_json()}, separators=(",", ":")))
        markers += len(frame.markers)
        if on_frame is not None:
            on_frame()
    head = json.dumps({"settings": {**asdict(settings), "photographs": None}}, indent=1)
    text = head[:-2] + ',\n "frames": [\n' + ",\n".join(rows) + "\n ]\n}\n"
    with write_whole(folder / "truth.json", overwrite=overwrite) as stream:
        stream.write(text.encode())
    return markers


def sample_frames(
    settings: SampleSettings, seed: int, indices: Iterable[int], jobs: int = 1
) -> Iterator[SampleFrame]:
    """Frames of a seed in order, rendered by one or more processes; the same either way."""
    work = [(settings, seed, index) for index in indices]
    if jobs <= 1:
        yield from (_sample(item) for item in work)
        return
    import multiprocessing

    context = multiprocessing.get_context("spawn")
    with context.Pool(jobs, _start_worker) as pool:
        yield from pool.imap(_sample, work, chunksize=8)


def _start_worker() -> None:
    import cv2

    cv2.setNumThreads(1)


def _sample(work: tuple[SampleSettings, int, int]) -> SampleFrame:
    return sample_frame(*work)
