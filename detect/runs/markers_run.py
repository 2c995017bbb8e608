"""Square markers over a whole run: frames in, a ``.markers`` file out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from detect.markers.settings import MarkerSettings
from detect.markers.templates import templates_of
from detect.run import ImageRun, Run
from detect.runs.conduct import PLAIN, Conduct
from detect.runs.dispatch import Workers
from detect.runs.frame import FramePlan
from detect.runs.stream import Output, RunSummary, detect_run
from landmarks import format_head


def detect_markers_run(
    run: ImageRun,
    settings: MarkerSettings,
    output: Path,
    *,
    version: str,
    overwrite: bool = False,
    pictures: Path | None = None,
    workers: Workers | None = None,
    on_progress: Callable[[], None] | None = None,
    conduct: Conduct = PLAIN,
) -> RunSummary:
    """Detect the square markers of a run and write them.

    Parameters
    ----------
    run : ImageRun
        The run; without a calibration, edges are taken to be straight in the images.
    settings : MarkerSettings
        What to look for.
    output : path
        The ``.markers`` file.
    version : str
        The program's version, for the file's head.
    overwrite : bool
        Whether existing files may be replaced.
    pictures : path, optional
        Folder for images with the markers drawn in.
    workers, on_progress, conduct
        As in `detect.runs.stream.detect_run`.

    Returns
    -------
    RunSummary

    Raises
    ------
    DetectError
        If there is no such dictionary, or it lacks an ID that is expected.
    storage.OutputExistsError
        If an output exists and must not be replaced.
    """
    templates_of(settings.dictionary, settings.ids)  # what is wrong with them is wrong with all
    plan = FramePlan(
        run.camera if isinstance(run, Run) else None,
        markers=settings,
        drawing=None if pictures is None else "markers",
        working_folder=Path.cwd(),
    )
    return detect_run(
        run,
        plan,
        [markers_file(output, settings, version, run)],
        overwrite=overwrite,
        pictures=pictures,
        workers=workers,
        on_progress=on_progress,
        conduct=conduct,
    )


def markers_file(path: Path, settings: MarkerSettings, version: str, run: ImageRun) -> Output:
    """A ``.markers`` file: what the rows mean and how they were made stands at its head."""
    odometry = run.odometry.name if run.odometry is not None else "none: the steps are zeros"
    camera = str(run.camera) if isinstance(run, Run) else "none: edges straight in the image"
    values = " ".join(
        f"{k}={str(v).replace(' ', '')}" for k, v in dataclasses.asdict(settings).items()
    )
    lines = [
        f"Square markers, detected by redetect {version}.",
        "STEP <image> <dX> <dY> <dPhi> <cXX> <cXY> <cYY> <cXPhi> <cYPhi> <cPhiPhi>",
        f"  odometry: {odometry}; the image was taken after the step",
        "LANDMARK_M <dictionary> <ID> <quality>, and for each corner <u> <v> <cUU> <cUV> <cVV>",
        "  corners top left, top right, bottom right, bottom left of the marker as printed;",
        "  pixels of the image as it is, the top left pixel's centre is 0 0; quality: 1 is perfect",
        f"camera {camera}",
        f"settings {values}",
    ]
    return Output(path, "markers", format_head("\n".join(lines)))
