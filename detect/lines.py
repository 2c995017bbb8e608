"""The detector of verticals: from one image to lines with bearings and standard deviations.

The path of an image, each step a function of its own:

    response        how well a step along the local vertical explains the grey values
    starts          its maxima on the horizon
    tracks          the edges through them, followed up and down
    fits            straight lines, refined on the grey values
    consensus       the tilt that most of them agree with; the others are no verticals
    tracks, fits    once more along the verticals of that tilt
    lines           bearings; one line for each edge, close ones joined

The first time a few edges will do if they leave no doubt about the tilt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from detect.errors import FrameError
from detect.line_filter import FilteredColumns
from detect.line_fit import LineFits
from detect.line_judgement import ACCEPTED, FATES, JOINED, judge_tracks, lines_of_tracks
from detect.line_settings import DEFAULT, LineSettings
from detect.line_tracks import LineTracks, line_starts, line_tracks
from detect.tilt import TiltEstimate
from landmarks import LineLandmark
from lut.verticals import VerticalTable

__all__ = ["ACCEPTED", "JOINED", "LineDetections", "detect_lines", "line_ends", "tilt_beyond_doubt"]

FloatArray = NDArray[np.float64]

#: A few edges tell the tilt beyond doubt if so many lines and such a part of the votes agree with
#: it, and if it tells the lean of verticals as well as this everywhere in the image. A track that
#: yields to its points by 7 % follows a lean that is wrong by twice as much at 0.15 px from it.
_FIRST_LINES = 6
_FIRST_VOTES = 0.75
_FIRST_LEAN_RAD = math.radians(0.15)
#: The refinement's steps that lines need for that.
_FIRST_STEPS = 2


@dataclass(frozen=True, slots=True, eq=False)
class LineDetections:
    """What was found in one image.

    Attributes
    ----------
    ends : (N, 4) float64
        xtop, ytop, xbottom, ybottom: undistorted normalised coordinates; leftmost line first.
    alpha_rad, beta_rad : (N,) float64
        Bearings and inclinations.
    sigma_rad : (N,) float64
        Standard deviations of the bearings.
    noise_rad : (N,) float64
        The part of them that is due to noise in the grey values.
    members : (N,) tuple of tuple of int
        The tracks that each line was made of, the strongest first; its ends are that one's.
    tilt : TiltEstimate or None
        None where too few lines agree.
    tracks : LineTracks
        All tracks.
    fits : LineFits
        Their lines.
    evidence : (T,) float64
        Evidence for each track.
    fate : (T,) tuple of str
        "accepted", "joined" (to a stronger one), or why the track is no line.
    """

    ends: FloatArray
    alpha_rad: FloatArray
    beta_rad: FloatArray
    sigma_rad: FloatArray
    noise_rad: FloatArray
    members: tuple[tuple[int, ...], ...]
    tilt: TiltEstimate | None
    tracks: LineTracks
    fits: LineFits
    evidence: FloatArray
    fate: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.alpha_rad)

    def landmarks(self) -> tuple[LineLandmark, ...]:
        """Rows for a landmark file, without identifiers; quality is 0 as in the data set's own."""
        return tuple(
            LineLandmark(
                xtop, ytop, xbottom, ybottom, alpha, beta, quality=0.0, sigma=sigma, ids=(-1,)
            )
            for (xtop, ytop, xbottom, ybottom), alpha, beta, sigma in zip(
                self.ends.tolist(),
                self.alpha_rad.tolist(),
                self.beta_rad.tolist(),
                self.sigma_rad.tolist(),
            )
        )


def detect_lines(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings = DEFAULT
) -> LineDetections:
    """Find the building's verticals in an image.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        See there; `detect.line_settings.PUBLISHED` are the report's.

    Returns
    -------
    LineDetections
        Lines, leftmost first, and all that they were made from.

    Raises
    ------
    FrameError
        If the image is not of the table's size or not of 8 bit grey values.
    """
    if image.shape != table.column.shape or image.dtype != np.uint8:
        raise FrameError(
            f"image is {image.dtype} of shape {image.shape}: expected uint8 of the table's shape "
            f"{table.column.shape}"
        )
    image = np.ascontiguousarray(image)
    starts = line_starts(image, table, settings)
    filtered = FilteredColumns.none_yet(table)

    enough = settings.first_edges if settings.guided and settings.first_edges else None
    tracks = line_tracks(image, starts, table, settings, filtered=filtered, enough=enough)
    tilt = None if tracks.complete else tilt_beyond_doubt(image, tracks, table, settings)
    if tilt is None:
        if not tracks.complete:
            tracks = line_tracks(image, starts, table, settings, filtered=filtered)
        judged = judge_tracks(image, tracks, table, settings)
        tilt = judged.tilt
    if settings.guided and tilt is not None:
        tracks = line_tracks(image, starts, table, settings, tilt, filtered)
        judged = judge_tracks(image, tracks, table, settings)

    members, bounds, lines = lines_of_tracks(tracks, judged, table, settings)
    return LineDetections(
        ends=lines[:4].T,
        alpha_rad=lines[4],
        beta_rad=lines[5],
        sigma_rad=lines[6],
        noise_rad=lines[7],
        members=_split(members, bounds),
        tilt=judged.tilt,
        tracks=tracks,
        fits=judged.fits,
        evidence=judged.evidence,
        fate=tuple(FATES[number] for number in judged.fate.tolist()),
    )


def tilt_beyond_doubt(
    image: NDArray[np.uint8], tracks: LineTracks, table: VerticalTable, settings: LineSettings
) -> TiltEstimate | None:
    """Tilt from a few edges, good enough to follow all of them by.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values, in scan order.
    tracks : LineTracks
        The few edges.
    table, settings
        As for `detect_lines`.

    Returns
    -------
    TiltEstimate or None
        None where it is in doubt. Lines are not refined to the end for it.
    """
    judged = judge_tracks(image, tracks, table, settings, steps=_FIRST_STEPS)
    if (
        judged.tilt is not None
        and judged.tilt.lines >= _FIRST_LINES
        and judged.votes >= _FIRST_VOTES
        and judged.lean_deviation_rad <= _FIRST_LEAN_RAD
    ):
        return judged.tilt
    return None


def line_ends(
    tracks: LineTracks, fits: LineFits, table: VerticalTable, chosen: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Ends of fitted lines at the first and last row of their tracks, and their inclinations.

    Parameters
    ----------
    tracks, fits, table
        As elsewhere.
    chosen : (N,) int64
        Which tracks.

    Returns
    -------
    ends : (N, 4) float64
        xtop, ytop, xbottom, ybottom: undistorted normalised coordinates.
    beta : (N,) float64
        Inclinations of the normals of their planes (rad).
    """
    from detect.line_bearing_kernels import ends_of_lines

    ends, beta = ends_of_lines(
        table.bearing_rad, table.elevation_tan, table.robot_from_camera,
        tracks.bounds, tracks.row, tracks.column, fits.reference_rad, fits.line, chosen,
    )  # fmt: skip
    return ends, beta


def _split(members: NDArray[np.int64], bounds: NDArray[np.int64]) -> tuple[tuple[int, ...], ...]:
    own, at = members.tolist(), bounds.tolist()
    return tuple(tuple(own[a:b]) for a, b in pairwise(at))
