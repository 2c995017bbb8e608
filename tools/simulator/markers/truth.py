"""What is true of the markers in an image: where their corners are, and how much of them is seen.

Corners are projected through the calibration; nothing here looks at the rendered image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from tools.simulator.markers.kernels import count_visible
from tools.simulator.markers.rendering import SurfaceArrays
from tools.simulator.markers.surface import FloatArray, Surface, square_corners

# Of the grid of points by which it is told how much of a marker is seen.
_POINTS = 24
#: Width of the white rim that must be seen for the marker's outline to be clear, in its widths.
RIM = 0.06


@dataclass(frozen=True, eq=False)
class MarkerTruth:
    """A marker in an image.

    Attributes
    ----------
    dictionary : str
        Which set it is from.
    id : int
        Its number there.
    corners : (4, 2) float64
        u, v (px, distortion included) of top left, top right, bottom right, bottom left.
    camera_from_marker : (4, 4) float64
        Where it is.
    width_m : float
        Width of its black square.
    width_px : float
        Mean length of its four sides in the image.
    slant_deg : float
        Between its normal and the line from its centre to the camera.
    contrast_grey : float
        White minus black in grey levels, at its centre.
    visible : float
        Share of the black square that is in the image and not hidden.
    rim_visible : float
        The same of the white rim round it, up to 6 % of its width.
    """

    dictionary: str
    id: int
    corners: FloatArray
    camera_from_marker: FloatArray
    width_m: float
    width_px: float
    slant_deg: float
    contrast_grey: float
    visible: float
    rim_visible: float

    @property
    def clear(self) -> bool:
        """Whether all of it is in view, its outline included."""
        return self.visible == 1.0 and self.rim_visible == 1.0

    def as_json(self) -> dict[str, Any]:
        """The same in plain numbers."""
        return {
            "dictionary": self.dictionary,
            "id": self.id,
            "corners": [[round(float(x), 5) for x in corner] for corner in self.corners],
            "width_m": self.width_m,
            "camera_from_marker": [
                [round(float(x), 9) for x in row] for row in self.camera_from_marker[:3]
            ],
            "width_px": round(self.width_px, 3),
            "slant_deg": round(self.slant_deg, 3),
            "contrast_grey": round(self.contrast_grey, 2),
            "visible": round(self.visible, 4),
            "rim_visible": round(self.rim_visible, 4),
        }


def marker_corners(camera: Camera, camera_from_marker: FloatArray, width_m: float) -> FloatArray:
    """(4, 2) pixels of a marker's corners; NaN where they are not seen."""
    points = square_corners(width_m) @ camera_from_marker[:3, :3].T + camera_from_marker[:3, 3]
    return camera.project(points)


def mean_side_px(corners: FloatArray) -> float:
    """Mean length of the sides of a quadrangle given by (4, 2) corners."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())


def slant_deg(camera_from_marker: FloatArray) -> float:
    """Angle between a marker's normal and the line to the camera: above 90 seen from behind."""
    centre = camera_from_marker[:3, 3]
    cosine = -(camera_from_marker[:3, 2] @ centre) / np.linalg.norm(centre)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def visible_shares(
    camera: Camera,
    surfaces: Sequence[Surface],
    which: int,
    width_m: float,
    arrays: SurfaceArrays | None = None,
) -> tuple[float, float]:
    """How much of a marker is in the image and not hidden.

    Parameters
    ----------
    camera : Camera
        The camera.
    surfaces : sequence of Surface
        All of the scene, in the camera frame.
    which : int
        The marker's card among them.
    width_m : float
        Width of its black square.
    arrays : SurfaceArrays, optional
        Of the same surfaces, if they are at hand.

    Returns
    -------
    visible, rim_visible : float
        Shares of the black square and of the rim round it; 0 where the card shows its back.
    """
    card = surfaces[which]
    if slant_deg(card.pose) >= 90.0:
        return 0.0, 0.0
    if arrays is None:
        arrays = SurfaceArrays(camera, surfaces)
    if which not in arrays.index:
        return 0.0, 0.0
    ticks = (np.arange(_POINTS) + 0.5) / _POINTS - 0.5
    a, b = np.meshgrid(ticks, ticks)
    square = np.column_stack([a.ravel(), b.ravel()])
    edge = np.linspace(-0.5 - RIM, 0.5 + RIM, 2 * _POINTS)
    far = np.full_like(edge, 0.5 + RIM)
    rim = np.concatenate(
        [np.column_stack(p) for p in ((edge, far), (edge, -far), (far, edge), (-far, edge))]
    )
    shares = []
    for points in (square, rim):
        at = width_m * points @ card.pose[:3, :2].T + card.pose[:3, 3]
        pixels = camera.project(at)
        inside = (
            (pixels[:, 0] > -0.5)
            & (pixels[:, 0] < camera.width - 0.5)
            & (pixels[:, 1] > -0.5)
            & (pixels[:, 1] < camera.height - 0.5)
        )
        seen: NDArray[np.float64] = at[inside]
        count = count_visible(
            np.ascontiguousarray(seen[:, 0] / seen[:, 2]),
            np.ascontiguousarray(seen[:, 1] / seen[:, 2]),
            arrays.index.index(which), arrays.to_texel, arrays.sizes, arrays.starts, arrays.texels,
            arrays.smooth,
        )  # fmt: skip
        shares.append(count / len(points))
    return shares[0], shares[1]
