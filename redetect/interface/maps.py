"""Least-squares maps, and localisation in them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, TypedDict, Unpack, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

from camera import Camera
from redetect import __version__
from redetect.json_text import json_text
from redetect.landmarks import map_file
from redetect.landmarks.map_file import LandmarkMap, MapLandmarks, Path2D
from redetect.least_squares import LossKind
from redetect.messages import excerpt, keywords_named, path_of
from redetect.slam.errors import SlamError
from redetect.slam.filters.localizer import localize_by_flags
from redetect.slam.filters.run import FilterRun
from redetect.slam.mapping.run_map import MappedRun, map_run_by_flags
from redetect.slam.models import OdometryNoise
from redetect.slam.options import Localize, Map
from redetect.slam.pictures import draw_map
from redetect.slam.recording import ASSUMED, first_poses, joined, read_runs
from redetect.slam.scoring import path_distance
from redetect.slam.settings import Association, RowErrors, Solver
from redetect.storage import OutputExistsError
from redetect.tables import Table, covariance_columns

PathLike = str | os.PathLike[str]
_OF_THE_COMMAND = {"output", "force", "interactive", "reference"}


class RowOptions(TypedDict, total=False):
    """Which rows of a run are read, and how; flags of the same names describe them."""

    stem: str | None
    camera: Camera | PathLike | None
    odometry_noise: OdometryNoise


class MapOptions(RowOptions, total=False):
    """Options of `map_landmarks`: flags of `slam map` (`redetect.slam.options.Map`)."""

    more: PathLike | Sequence[PathLike]  #: Further runs of the same building.
    calibrate: bool
    place: bool
    row_errors: RowErrors
    solver: Solver
    loss: LossKind
    loss_scale: float
    start: ArrayLike  #: (3,) pose at the start in the map (m, m, rad).


class LocalizeOptions(RowOptions, total=False):
    """Options of `localize`: flags of `slam localize` (`redetect.slam.options.Localize`)."""

    association: Association
    gate_probability: float
    start: ArrayLike  #: (3,) pose at the start in the map (m, m, rad).
    start_sigma: ArrayLike  #: (3,) its standard deviations.
    lost: bool


@dataclass(frozen=True, eq=False, repr=False)
class Poses(Table):
    """The poses of a path as a table."""

    #: Poses with covariances: the start, and one after each step.
    path: Path2D

    def columns(self) -> dict[str, Any]:
        """One row per pose, with covariances if the path has them."""
        columns: dict[str, Any] = {
            "prefix": list(self.path.prefixes),
            "x_m": self.path.poses[:, 0],
            "y_m": self.path.poses[:, 1],
            "theta_rad": self.path.poses[:, 2],
        }
        if self.path.covariance is not None:
            columns |= covariance_columns(self.path.covariance)
            columns["cthetatheta_rad2"] = self.path.covariance[:, 2, 2]
        return columns


@dataclass(frozen=True, eq=False, repr=False)
class RunMap(Table):
    """Least-squares map of a run; its frame is the robot's at the start, X left, Y backward."""

    discs: MapLandmarks  #: Identifiers, positions (m) and covariances (m^2).
    lines: MapLandmarks
    path: Path2D  #: Poses with covariances: the start, one after each step; then the next run's.
    paths: tuple[Path2D, ...]  #: The path of each run.
    result: MappedRun  #: Details: residuals, ignored rows, the camera's mounting.
    head: tuple[str, ...]  #: Version, runs and settings, for the head of the files.

    @property
    def chi_squared_factor(self) -> float:
        """Squared residuals per degree of freedom: 1 if all covariances are right."""
        return self.result.table.factor

    def columns(self) -> dict[str, Any]:
        """Discs, then verticals, one row each."""
        ids, xy, covariance, rows = (
            np.concatenate([vars(some)[name] for some in (self.discs, self.lines)])
            for name in ("ids", "xy", "covariance", "rows")
        )
        return {
            "kind": ["disc"] * len(self.discs) + ["vertical"] * len(self.lines),
            "id": ids,
            "x_m": xy[:, 0],
            "y_m": xy[:, 1],
            **covariance_columns(covariance),
            "rows": rows,
        }

    def poses(self) -> Poses:
        """The path as a table."""
        return Poses(self.path)

    def write(self, folder: PathLike, *, overwrite: bool = False) -> None:
        """Write map.csv with its joint covariance, and path.csv (of several runs path_1.csv,
        path_2.csv, ...), as `slam map` does.

        Parameters
        ----------
        folder : path
            Created if necessary.
        overwrite : bool
            Whether existing files may be replaced; else `redetect.storage.OutputExistsError`.
        """
        landmarks = self.result.landmarks_to_write()
        try:
            map_file.write_map_and_paths(
                Path(folder), landmarks, self.paths, self.head, overwrite=overwrite
            )
        except OutputExistsError as error:
            error.args = (str(error).replace("--force", "overwrite=True"),)
            raise

    def joint_covariance(self) -> Any:
        """(2 M, 2 M) covariance of all positions, discs first (m^2)."""
        return self.result.landmarks_jointly().joint_covariance

    def _repr_png_(self) -> bytes:
        return draw_map(self.result.landmarks, self.path)


@dataclass(frozen=True, eq=False, repr=False)
class Localization(Poses):
    """A run localised in a map."""

    result: FilterRun  #: Details, such as the use of the rows.
    landmarks: LandmarkMap  #: The map.

    def distance(self, reference: Path2D) -> Mapping[str, float]:
        """Distance from another path of the same run in the same map, m and rad."""
        if not isinstance(reference, Path2D):
            raise SlamError(f"{excerpt(reference)}: expected a path, as of a map or localization")
        return path_distance(self.path, reference.poses)

    def _repr_png_(self) -> bytes:
        return draw_map(self.landmarks, self.path)


@keywords_named()
def map_landmarks(
    run: PathLike, *, circles: bool = True, lines: bool = False, **options: Unpack[MapOptions]
) -> RunMap:
    """Map the landmarks of a run by least squares, as `slam map` does.

    Parameters
    ----------
    run : path
        Run folder, or a `.circles` or `.lines` file, with identifiers.
    circles, lines : bool
        Which landmarks to use.
    **options : MapOptions
        Further flags of `slam map` (`redetect.slam.options.Map`), such as `stem`, `calibrate`,
        `loss`, `start` or `more`, the paths of further runs of the same building.

    Returns
    -------
    RunMap

    Raises
    ------
    redetect.slam.errors.SlamError
        If no row has an identifier, the run is disconnected, or a calibration is missing.
    redetect.landmarks.LandmarkFileError
        If a file is malformed.
    """
    command = Map(**_flags(run, circles, lines, options, MapOptions))
    runs = read_runs(command)
    mapped = map_run_by_flags(command, joined(runs))
    landmarks, path = mapped.landmarks, mapped.path
    paths = tuple(path.part(*ends) for ends in pairwise(first_poses(runs).tolist()))
    settings = {
        each.name: value
        for each in fields(command)
        if each.name not in _OF_THE_COMMAND
        and not isinstance(value := getattr(command, each.name), Camera)
    }
    head = f"redetect.map {__version__}", json_text(settings, indent=None)
    return RunMap(landmarks.discs, landmarks.lines, path, paths, mapped, head)


@keywords_named()
def localize(
    run: PathLike, landmarks: RunMap | PathLike, *, circles: bool = True, lines: bool = False,
    **options: Unpack[LocalizeOptions],
) -> Localization:  # fmt: skip
    """Localise a run in a map, as `slam localize` does.

    Parameters
    ----------
    run : path
        Run folder, or a `.circles` or `.lines` file.
    landmarks : RunMap, or path
        The map, or its `map.csv`.
    circles, lines : bool
        Which landmarks to use.
    **options : LocalizeOptions
        Further flags of `slam localize` (`redetect.slam.options.Localize`), such as `association`
        or `start`.

    Returns
    -------
    Localization

    Raises
    ------
    redetect.slam.errors.SlamError
        If no row shows a landmark of the map.
    redetect.landmarks.LandmarkFileError
        If a file is malformed.
    """
    in_memory = isinstance(landmarks, RunMap)
    in_file = path_of("the map" if in_memory else landmarks, "a RunMap, or its map.csv", SlamError)
    command = Localize(map=in_file, **_flags(run, circles, lines, options, LocalizeOptions))
    if isinstance(landmarks, RunMap):
        places = landmarks.result.landmarks_to_write()
    else:
        places = map_file.with_joint_covariance(map_file.read_map(in_file), in_file)
    result = localize_by_flags(command, joined(read_runs(command)), places)
    return Localization(result.path, result, places)


def _flags(
    run: PathLike, circles: bool, lines: bool, options: Mapping[str, Any], kind: type
) -> dict[str, Any]:
    """Options as the command has them; a SlamError if there are none of that name."""
    if not circles and not lines:
        raise SlamError("circles and lines are False: expected at least one of them")
    flags, known = dict(options), get_type_hints(kind)
    if without_effect := flags.keys() & _OF_THE_COMMAND:
        raise SlamError(f"{', '.join(sorted(without_effect))}: of the command only")
    if unknown := sorted(flags.keys() - known):
        raise SlamError(f"{', '.join(unknown)}: no such option: expected {', '.join(known)}")
    for name in flags.keys() & {"start", "start_sigma"}:
        flags[name] = tuple(np.ravel(flags[name]).tolist())
        if len(flags[name]) != 3:
            raise SlamError(f"{name} is {excerpt(options[name])}: expected three numbers")
    if not isinstance(camera := flags.get("camera"), Camera | None):
        expected = "a Camera, or the name of its .cam file"
        flags["camera"] = path_of(camera, expected, SlamError)
    noise = flags.get("odometry_noise", ASSUMED)
    if not isinstance(noise, OdometryNoise):
        raise SlamError(f"odometry_noise is {excerpt(noise)}: expected an OdometryNoise")
    if "more" in flags:
        more = flags["more"]
        alone = isinstance(more, str | os.PathLike) or not isinstance(more, Iterable)
        flags["more"] = tuple(map(_run, [more] if alone else more))
    return {"run": _run(run), "circles": circles, "lines": lines, **flags}


def _run(name: PathLike) -> Path:
    expected = "a run folder or a file of rows; `redetect.landmarks.write_frames` writes detections"
    return path_of(name, expected, SlamError)
