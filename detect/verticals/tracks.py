"""From grey values to tracks: the response along the verticals, starts on the horizon, tracking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.filter import (
    FilteredColumns,
    LineFilter,
    StartBand,
    line_filter,
    start_band,
)
from detect.verticals.strip import strip_of
from detect.verticals.tilt import TiltEstimate
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LineStarts:
    """Where tracks start: maxima of the response near the horizon, the highest first.

    Attributes
    ----------
    row, column : (N,) int32
        Strip pixels.
    polarity : (N,) float32
        1 where the image is brighter on the right, -1 on the left.
    score : (N,) float32
        Absolute response there.
    """

    row: NDArray[np.int32]
    column: NDArray[np.int32]
    polarity: NDArray[np.float32]
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
    complete : bool
        Whether all edges were followed.
    """

    polarity: FloatArray
    bounds: NDArray[np.int64]
    row: NDArray[np.int32]
    column: FloatArray
    score: NDArray[np.float32]
    complete: bool

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


def line_response(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> NDArray[np.float32]:
    """How much a grey value step along a vertical explains, at every pixel of the strip.

    With Gaussian weights g round a point and h, the distance across the line in units of its
    weighted standard deviation, this is the sign of the covariance times

        Cov_g(h, I)^2 / (Var_g(I) + regulariser),

    the squared correlation of grey value and distance (DLR Spatial Cognition data set report, line
    detection). Affine changes of brightness change it only through the regulariser.

    The detector evaluates it only where tracks go.

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
    from detect.verticals.response_kernels import strip_response

    response = np.empty(image.shape, np.float32)
    window = line_filter(settings)
    strip_response(
        image,
        np.ascontiguousarray(table.column),
        table.first_row,
        table.last_row,
        window.weights,
        window.along,
        window.regulariser,
        response,
    )
    return response


def line_starts(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> LineStarts:
    """Maxima of the response on the horizon and on rows near it.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        Band round the horizon, threshold; the filter.

    Returns
    -------
    LineStarts
        The highest first.
    """
    from detect.verticals.start_kernels import find_starts

    response, band = start_response(image, table, settings)
    return LineStarts(*find_starts(response, band.row, settings.threshold, band.supported))


def start_response(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> tuple[NDArray[np.float32], StartBand]:
    """The response on the rows on which tracks start, as `line_response` up to a few percent.

    Returns
    -------
    response : (K, W) float32
        In the rows of the band.
    band : StartBand
        Which rows these are.
    """
    from detect.verticals.response_kernels import band_response

    window, band = line_filter(settings), start_band(table, settings)
    response = np.empty(band.row.shape, np.float32)
    band_response(
        np.ascontiguousarray(image),
        band.pixel,
        band.runs,
        band.lengths,
        band.odd,
        band.odd_bounds,
        band.part,
        band.scale,
        band.visible,
        band.spacing,
        band.weights,
        window.along,
        window.regulariser,
        response,
    )
    return response, band


def line_tracks(
    image: NDArray[np.uint8],
    starts: LineStarts,
    table: VerticalTable,
    settings: LineSettings,
    tilt: TiltEstimate | None = None,
    filtered: FilteredColumns | None = None,
    enough: int | None = None,
) -> LineTracks:
    """Follow the edges through the starts up and down.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    starts : LineStarts
        Where to start; those on an edge already followed are left out.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        Threshold, gaps, border.
    tilt : TiltEstimate, optional
        If given, edges are only followed along the verticals that it predicts; else wherever they
        go.
    filtered : FilteredColumns, optional
        What has been filtered of this very image when its edges were followed before; extended.
    enough : int, optional
        No more edges are followed once so many could be lines by their length and response.

    Returns
    -------
    LineTracks
        One for each edge.
    """
    from detect.verticals.follow_kernels import follow_edges

    window, strip = line_filter(settings), strip_of(table)
    if filtered is None:
        filtered = FilteredColumns.none_yet(table)
    return LineTracks(
        *follow_edges(
            padded_pixels(image, window),
            strip.column,
            strip.ends,
            strip.lean_by_pitch,
            strip.lean_by_roll,
            table.first_row,
            table.last_row,
            strip.rise,
            window.weights_between,
            window.weights.shape[1] // 2,
            window.along,
            window.regulariser,
            filtered.response,
            filtered.known,
            starts.row,
            starts.column,
            starts.polarity,
            tilt.pitch_rad if tilt is not None else 0.0,
            tilt.roll_rad if tilt is not None else 0.0,
            settings.threshold,
            settings.gap_rows,
            settings.border_rows,
            settings.guided_pull if tilt is not None else 1.0,
            settings.guided_reach_px if tilt is not None else 1.0,
            enough if enough is not None else len(starts.row) + 1,
            settings.least_points(table.row_aspect),
            settings.least_evidence / table.row_aspect,
        )
    )


def padded_pixels(image: NDArray[np.uint8], window: LineFilter) -> NDArray[np.uint8]:
    """The image in scan order, and behind it what the filter's weights of zero need."""
    flat = image.reshape(-1)
    missing = window.weights_between.shape[1] - window.weights.shape[1] - 1
    return np.pad(flat, (0, missing)) if missing else flat
