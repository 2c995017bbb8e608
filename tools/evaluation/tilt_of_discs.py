"""The tilt that the discs of a map show, beside the tilt that the verticals of a run show."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from tyro.conf import Positional

from camera import Camera, read_camera
from detect.projection import image_positions
from detect.sources.image_files import image_name
from redetect.array_types import FloatArray
from redetect.landmarks import read_frames, read_tilts, squared_mahalanobis
from redetect.landmarks.map_file import read_map, read_path
from redetect.slam.models import disc_in_robot
from tools.evaluation.figures import Figures, Study, demand_some, print_figures
from tools.evaluation.tables import Table

#: Least standard deviation of positions in the image, pixels along u.
_LEAST_SIGMA_PX = 0.3
#: Standard deviation of the tilt of a frame about the run's median: discs close together do not
#: determine it, and one wrong identifier among five could give any tilt (rad).
_SPREAD_RAD = np.radians(0.5)
_UNKNOWNS = 5
#: Lines and discs that a frame needs, and how many of the frames that differ most are listed.
_LEAST, _WORST = 5, 10
#: A frame whose two tilts differ by more than this many standard deviations is listed.
_FAR_SIGMAS = 4.0


class Tilt(NamedTuple):
    """Pitch and roll of one frame."""

    angles: FloatArray  # (2,) radians.
    covariance: FloatArray  # (2, 2), square radians.


def tilt_of_discs(
    camera: Camera,
    rows_xy: FloatArray,
    map_xy: FloatArray,
    pose: FloatArray,
    raised_m: float = 0.0,
    usual: FloatArray | None = None,
) -> Tilt:
    """Pose, pitch and roll that put discs of a map where the camera saw them, robustly.
    `rows_xy` (N, 2); `map_xy` (N, 2); `pose` (3,); `usual` (2,).
    """
    seen = image_positions(camera, rows_xy)
    # Errors are about equal in all directions of the lens, whatever the shape of a pixel.
    per_sigma = np.array([1.0, camera.scale_x / camera.scale_y]) / _LEAST_SIGMA_PX

    def residuals(unknowns: FloatArray) -> FloatArray:
        level, tilt = disc_in_robot(unknowns[:3], map_xy), unknowns[3:]
        off = image_positions(camera, level, (tilt[0], tilt[1]), raised_m) - seen
        of_discs = np.nan_to_num(off * per_sigma, nan=1000.0).ravel()
        if usual is None:
            return np.asarray(of_discs)
        return np.concatenate([of_discs, (tilt - usual) / _SPREAD_RAD])

    start = np.array([*pose, *(np.zeros(2) if usual is None else usual)])
    scale = [0.1, 0.1, 0.1, 0.01, 0.01]
    found = least_squares(residuals, start, loss="soft_l1", x_scale=scale)
    # From there, errors beyond some standard deviations are another disc's.
    found = least_squares(residuals, found.x, loss="cauchy", f_scale=3.0, x_scale=scale)
    freedom = len(found.fun) - _UNKNOWNS
    variance = max(2.0 * found.cost / max(freedom, 1), 1.0)
    covariance = variance * np.linalg.pinv(found.jac.T @ found.jac)
    return Tilt(found.x[3:], covariance[3:, 3:])


def compare_tilts(
    camera: Camera, rows: Path, tilts: Path, map_path: Path, path_path: Path, raised_m: float = 0.0
) -> dict[str, tuple[Tilt, Tilt]]:
    """By image, the tilt of a `.tilt` file and that of the discs of a map, if there are enough."""
    discs = read_map(map_path).discs
    place = dict(zip(discs.ids.tolist(), discs.xy, strict=True))
    path = read_path(path_path)
    poses = {image_name(p): pose for p, pose in zip(path.prefixes, path.poses, strict=True)}
    by_lines = {image_name(prefix): tilt for prefix, tilt in read_tilts(tilts).items()}
    of_lines, measured = {}, {}
    for frame in read_frames(rows):
        name = image_name(frame.step.prefix)
        tilt, pose = by_lines.get(name), poses.get(name)
        known = [row for row in frame.circles if row.ids and row.ids[0] in place]
        if tilt is None or pose is None or tilt.lines < _LEAST or len(known) < _LEAST:
            continue
        covariance = np.array([[tilt.cpp, tilt.cpr], [tilt.cpr, tilt.crr]])
        of_lines[name] = Tilt(np.array([tilt.pitch, tilt.roll]), covariance)
        rows_xy = np.array([(row.px, row.py) for row in known])
        measured[name] = rows_xy, np.array([place[row.ids[0]] for row in known]), pose
    alone = [tilt_of_discs(camera, *given, raised_m).angles for given in measured.values()]
    usual = np.median(alone, axis=0) if alone else None
    return {
        name: (of_lines[name], tilt_of_discs(camera, *given, raised_m, usual))
        for name, given in measured.items()
    }


def figures_of(tilts: dict[str, tuple[Tilt, Tilt]]) -> dict[str, Any]:
    """Print medians, means and spreads (degrees), and the frames that differ most; the figures."""
    columns = (
        f"{axis} {what}" for what in ("median", "mean", "spread") for axis in ("pitch", "roll")
    )
    table = Table({"tilt of": "<11", **dict.fromkeys(columns, "+.3f")})
    by_lines, by_discs = (
        np.degrees([tilt.angles for tilt in of]).reshape(-1, 2) for of in zip(*tilts.values())
    )
    off = np.degrees([lines.angles - discs.angles for lines, discs in tilts.values()])
    for name, values in (("verticals", by_lines), ("discs", by_discs), ("difference", off)):
        table.row(name, *np.median(values, axis=0), *values.mean(axis=0), *values.std(axis=0))
    squared = np.array([
        squared_mahalanobis(lines.angles - discs.angles, lines.covariance + discs.covariance)
        for lines, discs in tilts.values()
    ])  # fmt: skip
    # Of the differences in both covariances, per axis, as shares of the expected.
    squares = {
        "frames": len(off),
        "mean square": squared.mean() / 2.0,
        "median square": np.median(squared) / (2.0 * np.log(2.0)),
        f"beyond {_FAR_SIGMAS:g} sigma": np.sum(squared > _FAR_SIGMAS**2),
    }
    print_figures(squares)
    for k in np.argsort(-squared)[:_WORST]:
        sigmas = np.sqrt(squared[k])
        print(f"  {list(tilts)[k]}: {off[k, 0]:+.2f} {off[k, 1]:+.2f}, {sigmas:.1f} sigma")
    return {**squares, **table.figures}


@dataclass(frozen=True)
class TiltOfDiscs(Study):
    """Compare the tilt from verticals with the tilt from the discs of a map."""

    rows: Positional[Path]
    """Raw rows of discs with the map's identifiers (`detect circles --ids-from`)."""
    tilts: Positional[Path]  # Tilts of single frames (`detect lines`).
    camera: Path  # Calibration.
    map: Path  # `map.csv` of `slam map`.
    path: Path  # Its `path.csv`.
    raised_m: float = 0.0  # Height of the camera above the calibrated one.

    def measure(self) -> Figures:
        camera = read_camera(self.camera)
        files = self.rows, self.tilts, self.map, self.path
        tilts = compare_tilts(camera, *files, self.raised_m)
        demand_some(
            tilts, f"{self.rows}: frames with a pose, {_LEAST} lines, {_LEAST} discs of the map"
        )
        return figures_of(tilts)
