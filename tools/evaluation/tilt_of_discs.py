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
from tools.evaluation.figures import Figures, Study, print_figures
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


class DiscTilt(NamedTuple):
    """Pitch and roll of one frame by its discs."""

    discs: int
    pitch_rad: float
    roll_rad: float
    covariance: FloatArray  # (2, 2), square radians.


@dataclass(frozen=True, eq=False)
class TiltComparison:
    """The two tilts of the frames that have enough lines and discs."""

    prefixes: list[str]
    by_lines: FloatArray  # (N, 2) Pitch and roll, radians.
    by_discs: FloatArray  # (N, 2)
    squared: FloatArray  # (N,) Squared difference in units of both covariances; 2 is expected.


def tilt_of_discs(
    camera: Camera,
    rows_xy: FloatArray,
    map_xy: FloatArray,
    pose: FloatArray,
    raised_m: float = 0.0,
    usual: tuple[float, float] | None = None,
) -> DiscTilt:
    """Pose, pitch and roll that put discs of a map where the camera saw them, robustly.
    `rows_xy` (N, 2); `map_xy` (N, 2); `pose` (3,).
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

    start = np.array([*pose, *(usual or (0.0, 0.0))])
    scale = [0.1, 0.1, 0.1, 0.01, 0.01]
    found = least_squares(residuals, start, loss="soft_l1", x_scale=scale)
    # From there, errors beyond some standard deviations are another disc's.
    found = least_squares(residuals, found.x, loss="cauchy", f_scale=3.0, x_scale=scale)
    freedom = len(found.fun) - _UNKNOWNS
    variance = max(2.0 * found.cost / max(freedom, 1), 1.0)
    covariance = variance * np.linalg.pinv(found.jac.T @ found.jac)
    return DiscTilt(len(rows_xy), found.x[3], found.x[4], covariance[3:, 3:])


def compare_tilts(
    camera: Camera, rows: Path, tilts: Path, map_path: Path, path_path: Path, raised_m: float = 0.0
) -> TiltComparison:
    """Compare the tilts of a `.tilt` file with those of the discs of a map."""
    discs = read_map(map_path).discs
    place = dict(zip(discs.ids.tolist(), discs.xy, strict=True))
    path = read_path(path_path)
    poses = {image_name(p): pose for p, pose in zip(path.prefixes, path.poses, strict=True)}
    by_lines = {image_name(prefix): tilt for prefix, tilt in read_tilts(tilts).items()}
    prefixes, first, measured = [], [], []
    for frame in read_frames(rows):
        name = image_name(frame.step.prefix)
        tilt, pose = by_lines.get(name), poses.get(name)
        known = [
            ((row.px, row.py), place[row.ids[0]])
            for row in frame.circles
            if row.ids and row.ids[0] in place
        ]
        if tilt is None or pose is None or tilt.lines < _LEAST or len(known) < _LEAST:
            continue
        rows_xy, map_xy = (np.array(side) for side in zip(*known, strict=True))
        prefixes.append(name)
        first.append(tilt)
        measured.append((rows_xy, map_xy, pose))
    alone = [tilt_of_discs(camera, *given, raised_m) for given in measured]
    usual = np.median([(one.pitch_rad, one.roll_rad) for one in alone] or [(0.0, 0.0)], axis=0)
    shown = [
        tilt_of_discs(camera, *given, raised_m, (float(usual[0]), float(usual[1])))
        for given in measured
    ]
    squared = []
    for tilt, disc in zip(first, shown, strict=True):
        covariance = np.array([[tilt.cpp, tilt.cpr], [tilt.cpr, tilt.crr]]) + disc.covariance
        off = tilt.pitch - disc.pitch_rad, tilt.roll - disc.roll_rad
        squared.append(float(squared_mahalanobis(off, covariance)))
    return TiltComparison(
        prefixes,
        np.array([(tilt.pitch, tilt.roll) for tilt in first]).reshape(-1, 2),
        np.array([(disc.pitch_rad, disc.roll_rad) for disc in shown]).reshape(-1, 2),
        np.array(squared),
    )


def figures_of(result: TiltComparison) -> dict[str, Any]:
    """Print medians, means and spreads (degrees), and the frames that differ most; the figures."""
    names = (
        f"{axis} {what}" for what in ("median", "mean", "spread") for axis in ("pitch", "roll")
    )
    table = Table({"tilt of": "<11", **dict.fromkeys(names, "+.3f")})
    off = np.degrees(result.by_lines - result.by_discs)
    by_lines, by_discs = np.degrees(result.by_lines), np.degrees(result.by_discs)
    for name, values in (("verticals", by_lines), ("discs", by_discs), ("difference", off)):
        table.row(name, *np.median(values, axis=0), *values.mean(axis=0), *values.std(axis=0))
    # Of the differences in both covariances, per axis, as shares of the expected.
    squares = {
        "frames": len(off),
        "mean square": result.squared.mean() / 2.0,
        "median square": np.median(result.squared) / (2.0 * np.log(2.0)),
        f"beyond {_FAR_SIGMAS:g} sigma": np.sum(result.squared > _FAR_SIGMAS**2),
    }
    print_figures(squares)
    for k in np.argsort(-result.squared)[:_WORST]:
        sigmas = np.sqrt(result.squared[k])
        print(f"  {result.prefixes[k]}: {off[k, 0]:+.2f} {off[k, 1]:+.2f}, {sigmas:.1f} sigma")
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

    def measured(self) -> Figures:
        camera = read_camera(self.camera)
        files = self.rows, self.tilts, self.map, self.path
        return figures_of(compare_tilts(camera, *files, self.raised_m))
