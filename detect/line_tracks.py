"""From grey values to tracks: the response along the verticals, starts on the horizon, tracking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.tilt import TiltEstimate
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LineStarts:
    """Where tracks start: maxima of the response near the horizon, the highest first.

    Attributes
    ----------
    row, column : (N,) int32
        Strip pixels.
    score : (N,) float32
        Absolute response there.
    """

    row: NDArray[np.int32]
    column: NDArray[np.int32]
    score: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class LineTracks:
    """Edges followed through the strip image.

    Track t's points are ``bounds[t] : bounds[t + 1]`` of the point arrays, from top to bottom.

    Attributes
    ----------
    polarity : (T,) float64
        1 where the image is brighter on the right of the edge, -1 on the left.
    bounds : (T + 1,) int64
        See above.
    row : (P,) int32
        Image row of each point.
    column : (P,) float64
        Column in the strip: of the horizon, where the vertical through the point crosses it.
    score : (P,) float32
        Absolute response at the point.
    """

    polarity: FloatArray
    bounds: NDArray[np.int64]
    row: NDArray[np.int32]
    column: FloatArray
    score: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.polarity)

    @property
    def points(self) -> NDArray[np.int64]:
        """(T,) number of points of each track."""
        return np.diff(self.bounds)

    @property
    def top_row(self) -> NDArray[np.int32]:
        """(T,) first row of each track."""
        return self.row[self.bounds[:-1]]

    @property
    def bottom_row(self) -> NDArray[np.int32]:
        """(T,) last row of each track."""
        return self.row[self.bounds[1:] - 1]

    @property
    def total_score(self) -> FloatArray:
        """(T,) sum of the points' responses."""
        if not len(self):
            return np.zeros(0)
        return np.add.reduceat(self.score.astype(np.float64), self.bounds[:-1])


def gaussian_window(sigma: float) -> FloatArray:
    """Weights of sum 1 at whole pixels within three standard deviations of the middle."""
    reach = int(np.ceil(3.0 * sigma))
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.asarray(weight / weight.sum())


def line_response(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> NDArray[np.float32]:
    """How much a grey value step along a vertical explains, at every pixel of the strip.

    With Gaussian weights g round a point and h, the distance across the line in units of its
    weighted standard deviation, this is the sign of the covariance times

        Cov_g(h, I)^2 / (Var_g(I) + regulariser),

    the squared correlation of grey value and distance (DLR Spatial Cognition data set report, line
    detection). Affine changes of brightness change it only through the regulariser.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        Widths of the filter, regulariser.

    Returns
    -------
    (H, W) float32
        In [-1, 1], positive where the image is brighter on the right; 0 where it is not defined.
    """
    from detect.line_kernels import strip_response

    across = gaussian_window(settings.sigma_across_px)
    distance = np.arange(len(across)) - 0.5 * (len(across) - 1)
    lever = distance / np.sqrt(across @ distance**2)
    response = np.empty(image.shape, np.float32)
    strip_response(
        image,
        table.column,
        table.first_row,
        table.last_row,
        across.astype(np.float32),
        lever.astype(np.float32),
        gaussian_window(settings.sigma_along_rows).astype(np.float32),
        settings.regulariser,
        response,
    )
    return response


def line_starts(
    response: NDArray[np.float32], table: VerticalTable, settings: LineSettings
) -> LineStarts:
    """Maxima of the response on the horizon and on rows near it.

    Parameters
    ----------
    response : (H, W) float32
        See `line_response`.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        Band round the horizon, threshold.

    Returns
    -------
    LineStarts
        The highest first.
    """
    from detect.line_kernels import find_starts

    row, column, score = find_starts(
        response,
        table.horizon_row,
        table.first_row,
        table.last_row,
        settings.start_band_rows,
        settings.start_spacing_rows,
        settings.threshold,
        settings.border_rows,
    )
    order = np.argsort(-score, kind="stable")
    return LineStarts(row[order], column[order], score[order])


def line_tracks(
    response: NDArray[np.float32],
    starts: LineStarts,
    table: VerticalTable,
    settings: LineSettings,
    tilt: TiltEstimate | None = None,
) -> LineTracks:
    """Follow the edges through the starts up and down.

    Parameters
    ----------
    response : (H, W) float32
        See `line_response`.
    starts : LineStarts
        Where to start; those on an edge already followed are left out.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        Threshold, gaps, border.
    tilt : TiltEstimate, optional
        If given, edges are only followed along the verticals that it predicts; else wherever they
        go.

    Returns
    -------
    LineTracks
        One for each edge.
    """
    from detect.line_kernels import follow_edges

    return LineTracks(
        *follow_edges(
            response,
            table.bearing_rad,
            table.elevation_tan,
            starts.row,
            starts.column,
            tilt.pitch_rad if tilt is not None else 0.0,
            tilt.roll_rad if tilt is not None else 0.0,
            settings.threshold,
            settings.gap_rows,
            settings.border_rows,
            settings.guided_pull if tilt is not None else 1.0,
            settings.guided_reach_px if tilt is not None else 1.0,
        )
    )
