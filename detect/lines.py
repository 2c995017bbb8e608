"""The detector of verticals: from one image to lines with bearings and standard deviations.

The path of an image, each step a function of its own:

    response        how well a step along the local vertical explains the grey values
    starts          its maxima on the horizon
    tracks          the edges through them, followed up and down
    fits            straight lines, refined on the grey values
    consensus       the tilt that most of them agree with; the others are no verticals
    tracks, fits    once more along the verticals of that tilt
    lines           bearings; one line for each edge, close ones joined
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.errors import FrameError
from detect.line_bearing import (
    close_groups,
    compensated_bearings,
    inclinations,
    join_bearings,
)
from detect.line_filter import FilteredColumns
from detect.line_fit import LineFits, fit_lines, lean_onto_tilt, plane_normals_of_lines
from detect.line_settings import DEFAULT, LineSettings
from detect.line_tracks import (
    LineTracks,
    line_starts,
    line_tracks,
)
from detect.tilt import TiltEstimate, consensus, lean
from landmarks import LineLandmark
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]

ACCEPTED = "accepted"
JOINED = "joined"


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
    starts = line_starts(image, table, settings)
    filtered = FilteredColumns.none_yet(table)

    tracks = line_tracks(image, starts, table, settings, filtered=filtered)
    fits = fit_lines(image, tracks, table, settings)
    evidence = line_evidence(tracks, fits, table)
    fate = judge_lines(tracks, fits, evidence, table, settings)
    tilt = agree_on_tilt(fits, evidence, fate, settings)
    if settings.guided and tilt is not None:
        tracks = line_tracks(image, starts, table, settings, tilt, filtered)
        fits = fit_lines(image, tracks, table, settings)
        evidence = line_evidence(tracks, fits, table)
        fate = judge_lines(tracks, fits, evidence, table, settings)
        tilt = agree_on_tilt(fits, evidence, fate, settings)

    alpha, noise = line_bearings(fits, tilt, settings)
    groups = group_lines(alpha, tracks, fits, evidence, fate, settings)
    sigma = np.hypot(noise, settings.sigma_px * fits.pixel_rad)
    rows = [join_bearings(alpha[g], sigma[g], evidence[g]) for g in groups]
    strongest = np.array([g[0] for g in groups], dtype=np.intp)
    return LineDetections(
        ends=line_ends(tracks, fits, table, strongest),
        alpha_rad=np.array([row[0] for row in rows]),
        beta_rad=inclinations(fits.normal[strongest]),
        sigma_rad=np.array([row[1] for row in rows]),
        noise_rad=noise[strongest],
        members=tuple(tuple(int(t) for t in g) for g in groups),
        tilt=tilt,
        tracks=tracks,
        fits=fits,
        evidence=evidence,
        fate=tuple(fate),
    )


def line_evidence(tracks: LineTracks, fits: LineFits, table: VerticalTable) -> FloatArray:
    """(T,) how much speaks for each track: response summed over its length in pixel widths.

    Soft edges are shadows and glare more often than the building's: their evidence is weakened by
    the square of their sharpness.
    """
    return np.asarray(tracks.total_score * table.row_aspect * fits.sharpness**2)


def judge_lines(
    tracks: LineTracks,
    fits: LineFits,
    evidence: FloatArray,
    table: VerticalTable,
    settings: LineSettings,
) -> list[str]:
    """Tell for each track whether it can be a vertical, by itself: "accepted", or why not."""
    points = tracks.points
    length = points * table.row_aspect
    middle = np.clip(
        np.rint(tracks.column[tracks.bounds[:-1]]), 0, len(table.horizon_row) - 1
    ).astype(np.intp)
    horizon = table.horizon_row[middle]
    gap = np.maximum(horizon - tracks.bottom_row, tracks.top_row - horizon) * table.row_aspect
    noise_px = np.sqrt(fits.covariance[:, 0, 0]) / fits.pixel_rad
    fate = [ACCEPTED] * len(tracks)
    for reason, passed in (
        ("short", (points >= settings.least_rows) & (length >= settings.least_length_px)),
        ("no maximum", np.isfinite(fits.line[:, 0])),
        ("little evidence", evidence >= settings.least_evidence),
        ("off the track", fits.shift_px <= settings.largest_shift_px),
        ("not straight", fits.scatter_px <= settings.largest_scatter_px),
        ("off the horizon", gap <= settings.largest_horizon_gap_px),
        ("uncertain", noise_px <= settings.largest_noise_px),
    ):
        for t in np.flatnonzero(~passed):
            if fate[t] == ACCEPTED:
                fate[t] = reason
    accepted = np.flatnonzero([f == ACCEPTED for f in fate])
    if len(accepted):
        # How sharp an edge can be depends on the image's focus and motion.
        sharpness, contrast = fits.sharpness[accepted], fits.contrast[accepted]
        soft = sharpness < settings.least_sharpness * np.quantile(sharpness, 0.25)
        faint = contrast < np.median(contrast)
        doubtful = evidence[accepted] < settings.soft_evidence
        for t in accepted[soft & faint & doubtful]:
            fate[t] = "soft"
    return fate


def agree_on_tilt(
    fits: LineFits, evidence: FloatArray, fate: list[str], settings: LineSettings
) -> TiltEstimate | None:
    """Estimate the tilt from the accepted lines; those that disagree are marked "not vertical"."""
    accepted = np.flatnonzero([f == ACCEPTED for f in fate])
    noise = fits.covariance[accepted, 1, 1]
    # One pixel from end to end: 12 = (length / standard deviation of its points)^2.
    per_length = fits.pixel_rad[accepted] / np.sqrt(12.0 * fits.spread[accepted])
    tilt, consistent = consensus(
        fits.normal[accepted],
        noise + (settings.bend_px * per_length) ** 2,
        np.sqrt(
            math.radians(settings.largest_lean_deg) ** 2
            + settings.largest_lean_sigmas**2 * noise
            + (settings.largest_lean_px * per_length) ** 2
        ),
        np.minimum(evidence[accepted] / 10.0, settings.weight_limit),
        settings.consensus,
    )
    for t in accepted[~consistent]:
        fate[t] = "not vertical"
    return tilt


def line_bearings(
    fits: LineFits, tilt: TiltEstimate | None, settings: LineSettings
) -> tuple[FloatArray, FloatArray]:
    """(T,) bearings of lines in the settings' convention, and their noise (rad)."""
    line = fits.line
    variance = fits.covariance[:, 0, 0]
    if tilt is not None and settings.alpha == "level":
        expected = lean(fits.reference_rad, tilt.pitch_rad, tilt.roll_rad)
        intercept, variance = lean_onto_tilt(fits, expected, settings.consensus.building_rad)
        line = np.stack([intercept, line[:, 1]], axis=-1)
    normal = plane_normals_of_lines(fits.reference_rad, line)
    alpha = compensated_bearings(normal, tilt, published=settings.alpha == "published")
    return alpha, np.sqrt(variance)


def group_lines(
    alpha: FloatArray,
    tracks: LineTracks,
    fits: LineFits,
    evidence: FloatArray,
    fate: list[str],
    settings: LineSettings,
) -> list[NDArray[np.intp]]:
    """Gather tracks to lines: one for each edge, close ones together.

    Tracks that are left out or joined are marked so in `fate`.

    Returns
    -------
    list of arrays
        The tracks of each line, the strongest first; leftmost line first.
    """
    accepted = np.flatnonzero([f == ACCEPTED for f in fate])
    strongest_first = accepted[np.argsort(-evidence[accepted], kind="stable")]
    kept: list[int] = []
    for t in strongest_first:
        near = np.abs(alpha[kept] - alpha[t]) / fits.pixel_rad[t]
        same = tracks.polarity[kept] == tracks.polarity[t]
        weaker = evidence[t] < settings.join_share * evidence[kept]
        if np.any(same & (near < settings.same_edge_px)):
            fate[t] = "same edge"
        elif np.any(weaker & (near < settings.join_px)) or np.any(
            (near < settings.shoulder_px)
            & (fits.contrast[t] < settings.shoulder_share * fits.contrast[kept])
        ):
            fate[t] = "beside a stronger edge"
        else:
            kept.append(int(t))
    lines = np.array(kept, dtype=np.intp)
    group = close_groups(alpha[lines], settings.join_px * fits.pixel_rad[lines])
    groups = [lines[group == g] for g in range(group.max(initial=-1) + 1)]
    for members in groups:
        for t in members[1:]:
            fate[t] = JOINED
    return groups


def line_ends(
    tracks: LineTracks, fits: LineFits, table: VerticalTable, chosen: NDArray[np.intp]
) -> FloatArray:
    """Ends of fitted lines at the first and last row of their tracks.

    Parameters
    ----------
    tracks, fits, table
        As elsewhere.
    chosen : (N,) intp
        Which tracks.

    Returns
    -------
    (N, 4) float64
        xtop, ytop, xbottom, ybottom: undistorted normalised coordinates.
    """
    if not len(chosen):
        return np.zeros((0, 4))
    phi, line = fits.reference_rad[chosen], fits.line[chosen]
    ahead = np.stack([np.sin(phi), -np.cos(phi), np.zeros_like(phi)], axis=-1)
    left = np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], axis=-1)
    ends = []
    for point in (tracks.bounds[:-1][chosen], tracks.bounds[1:][chosen] - 1):
        row, column = tracks.row[point], tracks.column[point]
        rise = _between_columns(table.elevation_tan, row, column)
        for _ in range(2):
            x = line[:, 0] + line[:, 1] * rise
            z = rise * np.sqrt(1.0 + x * x)
            x = line[:, 0] + line[:, 1] * z
            column = table.columns_at(phi + np.arctan(x))
            moved = _between_columns(table.elevation_tan, row, column)
            # At the verticals' own ends the neighbouring column may end a row earlier.
            rise = np.where(np.isfinite(moved), moved, rise)
        z = rise * np.sqrt(1.0 + x * x)
        x = line[:, 0] + line[:, 1] * z
        direction = ahead + x[:, None] * left
        direction[:, 2] = z
        seen = direction @ table.robot_from_camera
        ends.append(seen[:, :2] / seen[:, 2:])
    return np.concatenate(ends, axis=-1)


def _between_columns(
    values: NDArray[np.float32], row: NDArray[np.int32], column: FloatArray
) -> FloatArray:
    """Values of a strip image at whole rows and fractional columns."""
    j = np.clip(column.astype(np.intp), 0, values.shape[1] - 2)
    part = column - j
    return np.asarray((1.0 - part) * values[row, j] + part * values[row, j + 1])
