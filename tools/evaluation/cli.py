"""Command line of the evaluation."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from tyro.conf import Positional, subcommand

from camera import read_camera
from detect.line_settings import PRESETS as LINE_PRESETS
from detect.line_settings import LineSettings
from detect.settings import CircleSettings
from redetect.landmarks import FrameTilt
from redetect.storage import write_whole
from redetect.storage.command_line import exit_code_of
from tools.evaluation.first_number import first_numbers, put_into
from tools.evaluation.first_number import table_of as first_numbers_table
from tools.evaluation.markers_command import Markers, MarkersCommand
from tools.evaluation.markers_command import perform as evaluate_markers
from tools.evaluation.published_lines import print_printed_lines
from tools.evaluation.real_run import measure_run, table_of
from tools.evaluation.rim_network_training import cross_validation, train_all
from tools.evaluation.second_look_data import gather
from tools.evaluation.tilt_of_discs import compare_tilts, report_of

_BLURS_PX = (0.3, 0.7, 1.2)
_BINS_M = ((0.0, 1.5), (1.5, 2.5), (2.5, 4.0), (4.0, 7.0))


@dataclass(frozen=True)
class Accuracy:
    """Refined centres of rendered single discs against the truth, by blur and distance.

    Parameters
    ----------
    camera : Path
        Calibration to render and fit through.
    discs : int
        Discs per blur.
    light : float
        Grey value of the discs.
    dark : float
        Grey value of the floor.
    noise : float
        Standard deviation of the noise, grey levels.
    seed : int
        Of places and noise.
    """

    camera: Path = Path("images/e/e.cam")
    discs: int = 400
    light: float = 220.0
    dark: float = 60.0
    noise: float = 2.0
    seed: int = 1


@dataclass(frozen=True)
class Disturbed:
    """Discs partly hidden, stained, badly lit or blurred, and look-alikes, rendered: what is found.

    Parameters
    ----------
    camera : Path
        Calibration to render and detect through.
    discs : int
        Discs of each family and share.
    shares : tuple of float
        Of the rim that are disturbed.
    polarity : str
        Stated to the detector; the discs are light.
    seed : int
        Of scenes and noise; the training of the network begins with 1.
    picture : Path
        Draw one disc of every family, and detect nothing.
    """

    camera: Path = Path("images/e/e.cam")
    discs: int = 100
    shares: tuple[float, ...] = (0.2, 0.3, 0.4)
    polarity: Literal["light", "any"] = "light"
    seed: int = 2
    picture: Path | None = None


@dataclass(frozen=True)
class Photographs:
    """Detect the discs of every folder below DATA/dev and score them with DATA/evaluate.py.

    Parameters
    ----------
    data : Path
        Folder with `evaluate.py` and `dev`.
    """

    data: Positional[Path] = Path("../shared/data/discs")


@dataclass(frozen=True)
class Rendered:
    """Detect the light discs of a rendered run and score them with its evaluate.py.

    Parameters
    ----------
    run : Path
        Folder of the run; `evaluate.py` stands beside it.
    """

    run: Positional[Path] = Path("../shared/data/rendered/r1")


@dataclass(frozen=True)
class Buildings:
    """Detect the verticals of every folder below DATA/dev and score them with DATA/evaluate.py.

    Parameters
    ----------
    data : Path
        Folder with `evaluate.py` and `dev`.
    preset : str
        Preset of the line detector.
    """

    data: Positional[Path] = Path("../shared/data/york")
    preset: Literal["default", "published", "report"] = "default"


@dataclass(frozen=True)
class PublishedLines:
    """Hold detected lines against the rows that the data set's report prints.

    Parameters
    ----------
    data : Path
        Folder with `published.json` and, in `dlr/e`, the first images of run e.
    preset : str
        Preset of the line detector.
    """

    data: Positional[Path] = Path("../shared/data")
    preset: Literal["default", "published", "report"] = "published"


@dataclass(frozen=True)
class RealRun:
    """Detect a recorded run by several presets, compare with its shipped rows, and map the rows.

    Parameters
    ----------
    run : Path
        Run folder with images, calibration and `map.circles`.
    """

    run: Positional[Path] = Path("../shared/data/dlr/e")


@dataclass(frozen=True)
class FirstNumbers:
    """What a stranger sees first: no flags, on the demo, a drive of one's own, a bag, photographs.

    Parameters
    ----------
    demo : Path
        The demo run.
    data : Path
        Evaluation data.
    document : Path
        Document whose table is written anew.
    """

    demo: Path = Path("images/e")
    data: Path = Path("../shared/data")
    document: Path | None = None


@dataclass(frozen=True)
class TrainRimNetwork:
    """Train the network of the second look at discs, and print what it finds in unseen buildings.

    Parameters
    ----------
    data : Path
        Folder with `rendered` and `dlr`.
    every : int
        Every n-th frame of the recorded run is used.
    scenes : int
        Rendered floors with disturbed discs.
    seed : int
        Of the disturbances and the networks.
    output : Path
        Where the weights go, which replace `detect/discs/rim_network.npz`.
    force : bool
        Replace that file.
    """

    data: Positional[Path] = Path("../shared/data")
    every: int = 8
    scenes: int = 500
    seed: int = 1
    output: Path = Path("build/rim_network.npz")
    force: bool = False


@dataclass(frozen=True)
class TiltOfDiscs:
    """Hold the tilt that verticals show against the tilt that the discs of a map show.

    Parameters
    ----------
    rows : Path
        Raw rows of discs with the map's identifiers (`detect circles --ids-from`).
    tilts : Path
        Tilts of single frames (`detect lines`).
    camera : Path
        Calibration.
    map : Path
        `map.csv` of `slam map`.
    path : Path
        Its `path.csv`.
    raised_m : float
        How much higher the camera is than calibrated.
    """

    rows: Positional[Path]
    tilts: Positional[Path]
    camera: Path
    map: Path
    path: Path
    raised_m: float = 0.0


@dataclass(frozen=True)
class RenderedLines:
    """Detect the verticals and the tilt of a rendered run; score both, and the discs levelled.

    Parameters
    ----------
    run : Path
        Folder of the run; `evaluate.py` stands beside it.
    preset : str
        Preset of the line detector.
    """

    run: Positional[Path] = Path("../shared/data/rendered/r1")
    preset: Literal["default", "published", "report"] = "default"


@dataclass(frozen=True)
class Tilt:
    """Detect the tilt of a simulated run, level its discs, and hold both against the truth.

    Parameters
    ----------
    run : Path
        Run made by `python -m tools.simulator`.
    tilt_prior_deg : float
        What is known of the tilt beforehand: its standard deviation about level, degrees.
    """

    run: Positional[Path] = Path("images/e")
    tilt_prior_deg: float = LINE_PRESETS["default"].tilt_prior_deg


def main(arguments: list[str] | None = None) -> int:
    """Run a subcommand; returns the exit code."""
    command = tyro.cli(
        Annotated[Accuracy, subcommand("accuracy")]
        | Annotated[Disturbed, subcommand("disturbed")]
        | Annotated[Photographs, subcommand("photographs")]
        | Annotated[Rendered, subcommand("rendered")]
        | Annotated[Buildings, subcommand("buildings")]
        | Annotated[PublishedLines, subcommand("published-lines")]
        | Annotated[RealRun, subcommand("real-run")]
        | Annotated[FirstNumbers, subcommand("first-numbers")]
        | Annotated[TrainRimNetwork, subcommand("train-rim-network")]
        | Annotated[TiltOfDiscs, subcommand("tilt-of-discs")]
        | Annotated[RenderedLines, subcommand("rendered-lines")]
        | Annotated[Tilt, subcommand("tilt")]
        | MarkersCommand,
        prog="python -m tools.evaluation",
        description="Prints the figures in the README.",
        args=arguments,
    )
    return exit_code_of(lambda: _carry_out(command))


def _carry_out(
    command: Accuracy
    | Disturbed
    | Photographs
    | Rendered
    | Buildings
    | PublishedLines
    | RealRun
    | FirstNumbers
    | TrainRimNetwork
    | TiltOfDiscs
    | RenderedLines
    | Tilt
    | Markers,
) -> int:
    if isinstance(command, Markers):
        return evaluate_markers(command)
    if isinstance(command, Accuracy):
        return _accuracy(command)
    if isinstance(command, Disturbed):
        return _disturbed(command)
    if isinstance(command, Photographs):
        return _photographs(command)
    if isinstance(command, Rendered):
        return _rendered(command)
    if isinstance(command, Buildings):
        return _buildings(command)
    if isinstance(command, PublishedLines):
        data = command.data
        print_printed_lines(data / "published.json", data / "dlr/e", LINE_PRESETS[command.preset])
        return 0
    if isinstance(command, RealRun):
        with tempfile.TemporaryDirectory() as folder:
            print(table_of(measure_run(command.run, Path(folder))))
        return 0
    if isinstance(command, FirstNumbers):
        with tempfile.TemporaryDirectory() as folder:
            numbers = list(first_numbers(command.demo, command.data, Path(folder)))
        print(first_numbers_table(numbers))
        if command.document is not None:
            put_into(command.document, first_numbers_table(numbers))
        return 0
    if isinstance(command, TrainRimNetwork):
        return _train_rim_network(command)
    if isinstance(command, TiltOfDiscs):
        compared = compare_tilts(
            read_camera(command.camera),
            command.rows,
            command.tilts,
            command.map,
            command.path,
            raised_m=command.raised_m,
        )
        print("\n".join(report_of(compared)))
        return 0
    if isinstance(command, RenderedLines):
        return _rendered_lines(command)
    return _tilt(command)


def _train_rim_network(command: TrainRimNetwork) -> int:
    glances, looks = gather(command.data, command.every, command.scenes, command.seed)
    for kind, of in (("glances", glances), ("looks", looks)):
        print(f"{len(of.is_disc)} {kind}, {of.is_disc.sum()} at discs")
    for line in cross_validation(glances, looks, command.seed):
        print(line)
    networks = train_all(glances, looks, command.seed)
    command.output.parent.mkdir(parents=True, exist_ok=True)
    weights: dict[str, Any] = networks.by_name()
    with write_whole(command.output, overwrite=command.force) as stream:
        np.savez(stream, **weights)
    print(f"{command.output}: {sum(array.size for array in weights.values())} weights")
    return 0


def _accuracy(command: Accuracy) -> int:
    from tools.evaluation.accuracy import measure_accuracy

    camera = read_camera(command.camera)
    print("blur px  distance m  discs   rms u px   rms v px  normalised error^2 / dof")
    for blur_px in _BLURS_PX:
        result = measure_accuracy(
            camera,
            CircleSettings(tilt_sigma_deg=0.0),
            discs=command.discs,
            light=command.light,
            dark=command.dark,
            blur_px=blur_px,
            noise=command.noise,
            seed=command.seed,
        )
        everything = np.ones(len(result.distance_m), bool)
        rows = [(f"{low:.1f}-{high:.1f}", low, high) for low, high in _BINS_M]
        for label, low, high in [*rows, ("all", 0.0, np.inf)]:
            chosen = everything & (result.distance_m >= low) & (result.distance_m < high)
            if chosen.any():
                rms = np.sqrt(np.mean(result.error_px[chosen] ** 2, axis=0))
                print(
                    f"{blur_px:7.1f}  {label:>10}  {chosen.sum():5d}  {rms[0]:9.4f}  {rms[1]:9.4f}"
                    f"  {result.normalised_error[chosen].mean():9.3f}"
                )
        print(f"         both coordinates {result.rms_px:.4f} px rms, {result.failed} failed")
    return 0


def _disturbed(command: Disturbed) -> int:
    import cv2

    from tools.evaluation.disturbed import measure, picture_of, table_of

    camera = read_camera(command.camera)
    settings = CircleSettings(polarity=command.polarity, tilt_sigma_deg=0.0)
    if command.picture is not None:
        picture = picture_of(camera, settings.radius_m, command.shares[-1], command.seed)
        _, png = cv2.imencode(".png", picture)
        with write_whole(command.picture, overwrite=True) as stream:
            stream.write(png.tobytes())
        return 0
    results = measure(
        camera, settings, discs=command.discs, shares=command.shares, seed=command.seed
    )
    print(table_of(list(results)))
    return 0


def _photographs(command: Photographs) -> int:
    with tempfile.TemporaryDirectory() as folder:
        files = []
        for run in sorted(path.parent for path in command.data.glob("dev/*/truth.json")):
            output = Path(folder) / f"{run.name}.circles"
            _detect(run, CircleSettings(), output)
            files.append(str(output))
        script = str(command.data / "evaluate.py")
        return subprocess.run([sys.executable, script, "--circles", *files], check=False).returncode


def _rendered(command: Rendered) -> int:
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "detected.circles"
        _detect(command.run, replace(CircleSettings(), polarity="light"), output)
        script = str((command.run.parent / "evaluate.py").resolve())
        # The scorer brings a module named camera: it must not find this project's.
        return subprocess.run(
            [sys.executable, script, command.run.name, str(output)], check=False, cwd=folder
        ).returncode


def _buildings(command: Buildings) -> int:
    with tempfile.TemporaryDirectory() as folder:
        files = []
        for run in sorted(path.parent for path in command.data.glob("dev/*/truth.json")):
            output = Path(folder) / f"{run.name}.lines"
            _detect_lines(run, LINE_PRESETS[command.preset], output)
            files.append(str(output))
        script = str(command.data / "evaluate.py")
        return subprocess.run([sys.executable, script, "--lines", *files], check=False).returncode


def _rendered_lines(command: RenderedLines) -> int:
    from redetect.landmarks import read_tilts

    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "detected.lines"
        _detect_lines(command.run, LINE_PRESETS[command.preset], output)
        tilts = read_tilts(output.with_suffix(".tilt"))
        discs = Path(folder) / "detected.circles"
        settings = replace(CircleSettings(), polarity="light")
        _detect(command.run, settings, discs, tilts)
        script = str((command.run.parent / "evaluate.py").resolve())
        code = 0
        for path in (output, discs):
            code |= subprocess.run(
                [sys.executable, script, command.run.name, str(path)], check=False, cwd=folder
            ).returncode
    _print_tilt_errors(command.run, tilts)
    return code


def _tilt(command: Tilt) -> int:
    from detect.comparison.compare import compare_runs
    from detect.viewing_options import CompareOptions
    from redetect.landmarks import read_tilts

    options = CompareOptions(gate_m=0.3)
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "detected.lines"
        lines = replace(LINE_PRESETS["default"], tilt_prior_deg=command.tilt_prior_deg)
        _detect_lines(command.run, lines, output)
        tilts = read_tilts(output.with_suffix(".tilt"))
        _print_tilt_errors(command.run, tilts)
        settings = replace(CircleSettings(), polarity="light", far_limit=0.5)
        for label, known in (("without", None), ("with", tilts)):
            discs = Path(folder) / f"{label}.circles"
            _detect(command.run, settings, discs, known)
            result = compare_runs(command.run, detected=discs, options=options)
            if result.error_median_m is None:
                print(f"discs {label} the tilt: none is near one of {result.reference_name}")
                continue
            far = [b for b in result.bins if b.from_m is not None and b.from_m >= 3.0]
            errors = ", ".join(
                f"{b.error_median_m:.4f}" for b in far if b.error_median_m is not None
            )
            print(
                f"discs {label} the tilt: median error {result.error_median_m:.4f} m, "
                f"from 3 m on, by bin: {errors} m, "
                f"normalised error^2 / dof {result.normalised_error.per_dof:.2f}"
            )
    return 0


def _print_tilt_errors(run: Path, tilts: dict[str, FrameTilt]) -> None:
    """Hold tilts against the truth of a rendered or simulated run."""
    truth = json.loads((run / "truth.json").read_text())
    errors, normalised = [], []
    for frame in truth["frames"]:
        tilt = tilts.get(frame["prefix"])
        if tilt is not None and tilt.lines >= 5:
            error = np.array([tilt.pitch, tilt.roll]) - np.array(frame["tilt"])
            covariance = np.array([[tilt.cpp, tilt.cpr], [tilt.cpr, tilt.crr]])
            errors.append(np.degrees(error))
            normalised.append(error @ np.linalg.solve(covariance, error) / 2.0)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    print(
        f"tilt: {len(errors)} frames with 5 lines, rms error pitch {rms[0]:.3f} deg "
        f"roll {rms[1]:.3f} deg, normalised error^2 / dof {np.mean(normalised):.2f}"
    )


def _detect_lines(run: Path, settings: LineSettings, output: Path) -> None:
    from detect.run import open_run
    from detect.runs.plan import FramePlan, Job
    from detect.runs.stream import detect_run

    opened = open_run(run)
    places = {"lines": output, "tilt": output.with_suffix(".tilt")}
    plan = FramePlan(opened.camera, lines=settings)
    summary = detect_run(Job(opened, plan, places))
    for failure in summary.failures:
        print(failure, file=sys.stderr)


def _detect(
    run: Path, settings: CircleSettings, output: Path, tilts: dict[str, FrameTilt] | None = None
) -> None:
    from detect.run import open_run
    from detect.runs.plan import FramePlan, Job, Known
    from detect.runs.stream import detect_run

    opened = open_run(run)
    plan = FramePlan(opened.camera, circles=settings)
    summary = detect_run(Job(opened, plan, {"circles": output}, Known(tilts=tilts)))
    for failure in summary.failures:
        print(failure, file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
