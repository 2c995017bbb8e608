"""A simulated session as a folder: a run folder per camera, calibrations, and the truth."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from camera import Camera, format_camera, write_camera
from redetect.groundtruth.markers.calibration import write_network, write_rig
from redetect.groundtruth.trajectories.streams import PlanarPoses, write_planar_poses
from redetect.storage import write_whole
from tools.simulator.markers.errors import CalibrationErrors, disturbed_network, disturbed_rig
from tools.simulator.markers.session import (
    SessionPlan,
    SessionSettings,
    View,
    plan_session,
    random_for,
    view_frame,
)
from tools.simulator.markers.surface import FloatArray
from tools.simulator.markers.truth import MarkerTruth

ImageFormat = Literal["png", "jpg"]

NOTE = (
    "SIMULATED, rendered by tools/simulator: no real robot drove here, and no real room looks "
    "like this"
)

_CONVENTIONS = {
    "world": "metres, z up, the floor is z = 0; the robot's area spans x and y from 0",
    "robot": "origin on the floor, x forward, y left, z up; theta: heading of x in the world, "
    "counter-clockwise (rad)",
    "marker": "origin at its centre, x right, y up, z out of the printed face; corners top left, "
    "top right, bottom right, bottom left of the marker as printed",
    "camera": "x right, y down, z forward; pixels u right, v down, (0, 0) the centre of the top "
    "left pixel; corners are where the lens images them, distortion included",
    "visible": "share of the black square that is in the image and not hidden; rim_visible: of the "
    "white rim round it",
}


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """The truth of one image."""

    camera: str
    prefix: str
    time_s: float
    markers: tuple[MarkerTruth, ...]


def write_session(
    settings: SessionSettings,
    folder: Path,
    *,
    errors: CalibrationErrors | None = None,
    image_format: ImageFormat = "jpg",
    quality: int = 92,
    jobs: int = 1,
    overwrite: bool = False,
    on_frame: Callable[[], None] | None = None,
) -> int:
    """Render a session and write its folder.

    Parameters
    ----------
    settings : SessionSettings
        The session.
    folder : Path
        Where it goes; made if missing.
    errors : CalibrationErrors, optional
        Of what the calibration files say; the images are always rendered with the true ones.
    image_format : str
        ``png`` without loss, or ``jpg``.
    quality : int
        Of the ``jpg`` files.
    jobs : int
        Processes that render.
    overwrite : bool
        Whether existing files may be replaced.
    on_frame : callable, optional
        Called after each image.

    Returns
    -------
    int
        Number of images.

    Raises
    ------
    redetect.storage.OutputExistsError
        If a file exists and `overwrite` is false.
    """
    plan = plan_session(settings)
    errors = CalibrationErrors() if errors is None else errors
    names = plan.network.names
    write_calibrations(plan, errors, folder, overwrite=overwrite)
    work = [(c, f) for c in range(len(names)) for f in range(len(plan.times_s))]
    seen: list[SeenFrame] = []
    for (camera, frame), view in zip(work, _views(plan, work, jobs)):
        prefix = plan.prefix(frame)
        write_image(
            folder / names[camera] / "images" / f"{prefix}.{image_format}", view, quality,
            overwrite=overwrite,
        )  # fmt: skip
        seen.append(SeenFrame(names[camera], prefix, float(plan.times_s[frame]), view.markers))
        if on_frame is not None:
            on_frame()
    for name in names:
        write_times(folder / name / f"{name}.times", [s for s in seen if s.camera == name],
                    overwrite=overwrite)  # fmt: skip
    write_poses(folder / "truth.csv", plan.times_s, plan.poses, overwrite=overwrite)
    still = slice(0, plan.references)
    write_poses(folder / "reference.csv", plan.times_s[still], plan.poses[still],
                overwrite=overwrite)  # fmt: skip
    write_truth(folder / "truth.json", plan, errors, seen, overwrite=overwrite)
    return len(work)


def write_calibrations(
    plan: SessionPlan, errors: CalibrationErrors, folder: Path, *, overwrite: bool
) -> None:
    """Write ``network.json``, ``rig.json`` and a ``.cam`` per camera, with errors; make folders."""
    network = disturbed_network(plan.network, errors, random_for(plan.settings.seed, "errors", 0))
    rig = disturbed_rig(plan.rig, errors, random_for(plan.settings.seed, "errors", 1))
    for name, camera in zip(network.names, network.cameras):
        (folder / name / "images").mkdir(parents=True, exist_ok=True)
        write_camera(camera, folder / name / f"{name}.cam", overwrite=overwrite)
    extra = {"note": NOTE, "errors": asdict(errors)}
    write_network(folder / "network.json", network, extra, overwrite=overwrite)
    write_rig(folder / "rig.json", rig, extra, overwrite=overwrite)


def write_image(path: Path, view: View, quality: int, *, overwrite: bool) -> None:
    """Write a view's image in the format that the file's name says."""
    import cv2

    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if path.suffix == ".jpg" else []
    done, encoded = cv2.imencode(path.suffix, view.image, options)
    if not done:
        raise ValueError(f"{path}: an image of {view.image.shape} could not be encoded")
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(bytes(encoded))


def write_times(path: Path, seen: Sequence[SeenFrame], *, overwrite: bool) -> None:
    """Write the rows ``prefix seconds`` of a camera's images."""
    rows = [f"# {NOTE}", "# image seconds", *(f"{s.prefix} {s.time_s:.6f}" for s in seen)]
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(("\n".join(rows) + "\n").encode())


def write_poses(path: Path, times_s: FloatArray, poses: FloatArray, *, overwrite: bool) -> None:
    """Write rows t, x, y, theta as RAWSEEDS' streams have them."""
    write_planar_poses(path, PlanarPoses(times_s, poses), overwrite=overwrite)


def write_truth(
    path: Path,
    plan: SessionPlan,
    errors: CalibrationErrors,
    seen: Sequence[SeenFrame],
    *,
    overwrite: bool,
    extra: dict[str, Any] | None = None,
) -> None:
    """Write all that is known about a session: true calibrations, and markers image by image."""
    head: dict[str, Any] = {
        "note": NOTE,
        "conventions": _CONVENTIONS,
        "settings": asdict(plan.settings),
        "errors": asdict(errors),
        "references": plan.references,
        "cameras": {
            name: {"calibration": camera_text(camera), "world_from_camera": matrix_rows(pose)}
            for name, camera, pose in zip(
                plan.network.names, plan.network.cameras, plan.network.world_from_camera
            )
        },
        "markers": {
            str(marker): {"width_m": float(width), "robot_from_marker": matrix_rows(pose)}
            for marker, width, pose in zip(
                plan.rig.ids, plan.rig.widths_m, plan.rig.robot_from_marker
            )
        },
        **(extra or {}),
    }
    frames = ",\n".join(
        json.dumps(
            {"camera": s.camera, "image": s.prefix, "t": s.time_s,
             "markers": [_marker_json(m) for m in s.markers]},
            separators=(",", ":"),
        )
        for s in seen
    )  # fmt: skip
    text = json.dumps(head, indent=1)[:-2] + f',\n "frames": [\n{frames}\n ]\n}}\n'
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(text.encode())


def matrix_rows(pose: FloatArray) -> list[list[float]]:
    """A (4, 4) transform's first three rows as plain numbers."""
    return [[round(float(x), 12) for x in row] for row in pose[:3]]


def camera_text(camera: Camera) -> str:
    """A calibration as the text of its file."""
    return format_camera(camera)


def _marker_json(marker: MarkerTruth) -> dict[str, Any]:
    numbers = marker.as_json()
    for known in ("dictionary", "width_m", "camera_from_marker"):
        del numbers[known]
    numbers["corners"] = np.round(marker.corners, 4).tolist()
    return numbers


# -- processes ------------------------------------------------------------------------------

_plan_of_worker: SessionPlan | None = None


def _views(plan: SessionPlan, work: Sequence[tuple[int, int]], jobs: int) -> Iterator[View]:
    if jobs <= 1:
        yield from (view_frame(plan, camera, frame) for camera, frame in work)
        return
    import multiprocessing

    context = multiprocessing.get_context("spawn")
    with context.Pool(jobs, _start_worker, (plan.settings,)) as pool:
        yield from pool.imap(_view_in_worker, work, chunksize=8)


def _start_worker(settings: SessionSettings) -> None:
    """Make the plan anew: it comes out the same."""
    global _plan_of_worker
    import cv2

    cv2.setNumThreads(1)
    _plan_of_worker = plan_session(settings)


def _view_in_worker(work: tuple[int, int]) -> View:
    if _plan_of_worker is None:
        raise RuntimeError("the worker has no plan: it was not started by _start_worker")
    return view_frame(_plan_of_worker, *work)
