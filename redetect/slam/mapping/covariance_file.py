"""The joint covariance of a map's landmarks, in a file beside the map.

A map's own file holds the covariance of each landmark by itself. Landmarks of a map made by driving
share most of their error with their neighbours (the drift from the start), which only the joint
covariance describes.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from redetect.array_types import FloatArray
from redetect.landmarks.map_file import LandmarkMap
from redetect.least_squares.covariance import chosen_covariance
from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.mapping.graph_terms import Weighting, layout_of
from redetect.slam.mapping.solve import equations_at
from redetect.storage import write_whole
from redetect.storage.bounded import read_plain_array

# Both files are written in full precision; sums may be in another order.
_SMALL_BYTES = 1 << 20
_SAME = 1e-6


def covariance_file(map_file: Path) -> Path:
    """Where the joint covariance of a map is: ``map_covariance.npy`` beside ``map.csv``."""
    return map_file.with_name(f"{map_file.stem}_covariance.npy")


def write_joint_covariance(map_file: Path, covariance: FloatArray, *, overwrite: bool) -> None:
    """Write a map's joint covariance beside it.

    Parameters
    ----------
    map_file : Path
        The map.
    covariance : (2 M, 2 M) float64
        x and y of each landmark in the order of the map's rows (m^2).
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    redetect.storage.OutputExistsError
        If the file exists and may not be replaced.
    """
    content = io.BytesIO()
    np.save(content, np.ascontiguousarray(covariance, dtype=np.float64), allow_pickle=False)
    with write_whole(covariance_file(map_file), overwrite=overwrite) as stream:
        stream.write(content.getvalue())


def read_joint_covariance(map_file: Path, landmark_map: LandmarkMap) -> FloatArray | None:
    """Read the joint covariance of a map, if there is one beside it.

    Parameters
    ----------
    map_file : Path
        The map.
    landmark_map : LandmarkMap
        Its content.

    Returns
    -------
    (2 M, 2 M) float64, or None
        None if there is no such file.

    Raises
    ------
    SlamError
        If it is malformed, or not of this map.
    """
    path = covariance_file(map_file)
    if not path.is_file():
        return None
    own = np.concatenate([landmark_map.discs.covariance, landmark_map.lines.covariance])
    try:
        with path.open("rb") as stream:
            found = read_plain_array(
                stream, np.dtype(np.float64), 2, max(32 * len(own) ** 2, _SMALL_BYTES)
            )
    except OSError as error:
        raise SlamError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise SlamError(f"{path}: cannot be read: {error}") from None
    if found.shape != (2 * len(own), 2 * len(own)) or found.dtype != np.float64:
        raise SlamError(
            f"{path}: {found.dtype} of shape {found.shape}: expected float64 of "
            f"{(2 * len(own), 2 * len(own))}, x and y of each landmark of {map_file}"
        )
    k = np.arange(len(own))
    blocks = found.reshape(len(own), 2, len(own), 2)[k, :, k, :]
    scale = float(np.max(np.abs(own), initial=0.0))
    if not np.all(np.isfinite(found)) or not np.allclose(
        blocks, own, rtol=_SAME, atol=_SAME * scale
    ):
        raise SlamError(f"{path}: not the covariance of {map_file}: expected that of each landmark")
    return np.asarray(0.5 * (found + found.T))


def joint_covariance(graph: Graph, estimate: Estimate, weighting: Weighting) -> FloatArray:
    """Joint covariance of all landmarks at a least-squares solution.

    Parameters
    ----------
    graph : Graph
        The measurements.
    estimate : Estimate
        Where their sum of squares is least.
    weighting : Weighting
        As it was minimised.

    Returns
    -------
    (2 M, 2 M) float64
        Discs, then lines (m^2).

    Raises
    ------
    SlamError
        If the measurements do not determine the unknowns.
    """
    layout = layout_of(graph, weighting)
    landmarks = np.arange(layout.first_disc, layout.size)
    try:
        return chosen_covariance(equations_at(graph, estimate, weighting), landmarks)
    except np.linalg.LinAlgError:
        raise SlamError(
            "covariances: the measurements do not determine all poses and landmarks"
        ) from None
