"""From tracks to straight lines: eigen-decomposition, and refinement on the grey values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.line_step_filters import step_filters
from detect.line_tracks import LineTracks
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LineFits:
    """Straight lines through tracks, each in the chart round a reference bearing.

    A direction at bearing `reference_rad` + d whose elevation has tangent e is X = tan(d),
    Z = e / cos(d) in the chart; the line is X = a + b Z.

    Attributes
    ----------
    reference_rad : (T,) float64
        Bearing of the chart's origin.
    pixel_rad : (T,) float64
        Width of a pixel's column at the horizon there.
    line : (T, 2) float64
        a, b; NaN where there is no line.
    covariance : (T, 2, 2) float64
        Of a, b, due to noise.
    scatter_px : (T,) float64
        Root-mean-square distance of the tracked points from their straight line, pixels.
    shift_px : (T,) float64
        How far the refinement took the line's middle, pixels.
    spread : (T,) float64
        Variance of the points' Z.
    contrast : (T,) float64
        Height of the step in grey values; NaN without refinement.
    sharpness : (T,) float64
        Contrast at the fine scale relative to the coarse one, at most 1; 1 without refinement.
    """

    reference_rad: FloatArray
    pixel_rad: FloatArray
    line: FloatArray
    covariance: FloatArray
    scatter_px: FloatArray
    shift_px: FloatArray
    spread: FloatArray
    contrast: FloatArray
    sharpness: FloatArray

    @property
    def normal(self) -> FloatArray:
        """(T, 3) unit normals of the lines' planes, robot frame (see `detect.line_bearing`)."""
        return plane_normals_of_lines(self.reference_rad, self.line)


def plane_normals_of_lines(reference_rad: FloatArray, line: FloatArray) -> FloatArray:
    """Unit normals of the planes of lines in charts.

    Parameters
    ----------
    reference_rad : (...) float64
        Bearings of the charts' origins.
    line : (..., 2) float64
        a, b.

    Returns
    -------
    (..., 3) float64
        Robot frame, as `detect.line_bearing.plane_normals` has them.
    """
    sine, cosine = np.sin(reference_rad), np.cos(reference_rad)
    a, b = line[..., 0], line[..., 1]
    normal = np.stack([cosine - a * sine, sine + a * cosine, -b], axis=-1)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def fit_lines(
    image: NDArray[np.uint8], tracks: LineTracks, table: VerticalTable, settings: LineSettings
) -> LineFits:
    """Fit a straight line to each track and refine it where the settings say so.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    tracks : LineTracks
        The tracks.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        Scales of the refinement.

    Returns
    -------
    LineFits
        One for each track; those too short or too faint to be lines have none. Without refinement
        the covariance is that of independent points with the scatter that the track shows.
    """
    from detect.line_fit_kernels import fit_eigenlines, refine_lines

    reference, pixel, line, scatter_px, middle, spread, rise, off = fit_eigenlines(
        table.bearing_rad, table.elevation_tan, tracks.bounds, tracks.row, tracks.column,
        tracks.score, settings.least_points(table.row_aspect),
        settings.least_evidence / table.row_aspect,
    )  # fmt: skip
    if not settings.refine_steps_px:
        count = len(tracks)
        return LineFits(
            reference_rad=reference,
            pixel_rad=pixel,
            line=line,
            covariance=_regression_covariance(scatter_px * pixel, tracks.points, middle, spread),
            scatter_px=scatter_px,
            shift_px=np.zeros(count),
            spread=spread,
            contrast=np.full(count, np.nan),
            sharpness=np.ones(count),
        )
    scales, farthest = zip(*settings.refine_steps_px)
    filters = step_filters((*scales, settings.fine_scale_px, settings.coarse_scale_px))
    line, covariance, shift_px, contrast, sharpness = refine_lines(
        np.ascontiguousarray(image), table.column, table.bearing_rad,
        tracks.polarity, tracks.bounds, tracks.row, tracks.column, reference, pixel, middle,
        rise, off, filters.half, filters.begin,
        filters.height, filters.first, filters.second, np.array(farthest), line,
    )  # fmt: skip
    return LineFits(
        reference_rad=reference,
        pixel_rad=pixel,
        line=line,
        covariance=covariance,
        scatter_px=scatter_px,
        shift_px=shift_px,
        spread=spread,
        contrast=contrast,
        sharpness=sharpness,
    )


def _regression_covariance(
    scatter: FloatArray, points: NDArray[np.int64], middle: FloatArray, spread: FloatArray
) -> FloatArray:
    """Covariance of a, b of a regression on points with independent errors."""
    with np.errstate(divide="ignore", invalid="ignore"):
        of_mean = scatter**2 / np.maximum(points - 2, 1)
        of_lean = of_mean / spread
    covariance = np.empty((len(points), 2, 2))
    covariance[:, 0, 0] = of_mean + middle**2 * of_lean
    covariance[:, 0, 1] = covariance[:, 1, 0] = -middle * of_lean
    covariance[:, 1, 1] = of_lean
    return covariance
