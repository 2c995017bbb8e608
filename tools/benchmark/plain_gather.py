"""The quality map without the table's runs: what copying stretches of rows is measured against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import camera_numbers
from lut import DiscShape, DiscTable, floor_positions, ring
from tools.benchmark.kernels import gathered_quality, sample_indices


@dataclass(frozen=True)
class GatherTable:
    """The image pixel of every sample of every usable centre.

    Attributes
    ----------
    shape : (H, W)
        Of the image.
    centres : (N, 2) int32
        Usable centres (u, v), in scan order.
    index : (N, 2 K) int32
        See `tools.benchmark.kernels.sample_indices`.
    votes_inner, votes_outer : (N,) uint8
        Samples of each outline inside the image.
    """

    shape: tuple[int, int]
    centres: NDArray[np.int32]
    index: NDArray[np.int32]
    votes_inner: NDArray[np.uint8]
    votes_outer: NDArray[np.uint8]


def gather_table(camera: Camera, shape: DiscShape, table: DiscTable) -> GatherTable:
    """Project all samples of the centres that a detector's table holds usable.

    Parameters
    ----------
    camera : Camera
        The calibrated camera.
    shape : DiscShape
        Outlines.
    table : DiscTable
        The detector's table for both; only its usable centres are taken over.

    Returns
    -------
    GatherTable
    """
    rows, columns = np.nonzero(table.usable)
    centres = np.stack([columns, rows], axis=-1).astype(np.int32)
    rings = np.concatenate(
        [ring(shape.inner_radius_m, shape.samples), ring(shape.outer_radius_m, shape.samples)]
    )
    index = sample_indices(
        camera_numbers(camera),
        floor_positions(camera),
        centres,
        rings,
        camera.height,
        camera.width,
    )
    inside = index != 0
    return GatherTable(
        (camera.height, camera.width),
        centres,
        index,
        np.count_nonzero(inside[:, : shape.samples], axis=1).astype(np.uint8),
        np.count_nonzero(inside[:, shape.samples :], axis=1).astype(np.uint8),
    )


def plain_quality_of_centres(
    image: NDArray[np.uint8], table: GatherTable
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """The same maps as `detect.circles.quality_of_centres`, by one gather per sample.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    table : GatherTable
        The camera's.

    Returns
    -------
    quality : (H, W) float64
    contrast : (H, W) float32
    """
    quality = np.zeros(table.shape)
    contrast = np.zeros(table.shape, np.float32)
    padded = np.pad(image, 1).ravel()
    gathered_quality(
        padded,
        table.index,
        table.centres,
        table.votes_inner,
        table.votes_outer,
        quality,
        contrast,
    )
    return quality, contrast
