"""Truth of the markers in an image: their corners, and the shares of them that are visible.

Corners are projected through the calibration; the rendered image is not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from camera import Camera
from redetect.array_types import FloatArray
from tools.simulator.files import rounded
from tools.simulator.markers.kernels import SurfaceArrays, count_visible
from tools.simulator.markers.surface import Surface, square_corners

# Points along a side of the grid that determines how much of a marker is visible.
_POINTS = 24
#: Width of the white rim that must be seen for the marker's outline to be clear, in its widths.
RIM = 0.06


@dataclass(frozen=True, eq=False)
class MarkerTruth:
    """A marker in an image."""

    dictionary: str  # Which set it is from.
    id: int  # Its number there.
    corners: FloatArray
    """(4, 2) u, v (px, distortion included) of top left, top right, bottom right, bottom left."""
    camera_from_marker: FloatArray  # (4, 4) Where it is.
    width_m: float  # Width of its black square.
    width_px: float  # Mean length of its four sides in the image.
    slant_deg: float  # Between its normal and the line from its centre to the camera.
    contrast_grey: float  # White minus black in grey levels, at its centre.
    visible: float  # Share of the black square that is in the image and not hidden.
    rim_visible: float  # The same of the white rim round it, up to 6 % of its width.

    @property
    def clear(self) -> bool:
        """Whether all of it is in view, its outline included."""
        return self.visible == 1.0 and self.rim_visible == 1.0

    def as_json(self) -> dict[str, Any]:
        """All of it as JSON."""
        return {
            "dictionary": self.dictionary,
            "id": self.id,
            "corners": [rounded(corner, 5) for corner in self.corners],
            "width_m": self.width_m,
            "camera_from_marker": [rounded(row, 9) for row in self.camera_from_marker[:3]],
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
    camera: Camera, surfaces: Sequence[Surface], which: int, width_m: float, arrays: SurfaceArrays
) -> tuple[float, float]:
    """How much of a marker's black square, and of the rim round it, is in the image and not hidden.

    `surfaces` are all of the scene in the camera frame, `which` is the marker's card among them,
    `arrays` are the same surfaces for the kernels. 0 where the card shows its back.
    """
    card = surfaces[which]
    number = np.flatnonzero(arrays.given == which)
    if slant_deg(card.pose) >= 90.0 or len(number) == 0:
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
        size = np.array([camera.width, camera.height])
        seen = at[np.all((pixels > -0.5) & (pixels < size - 0.5), axis=1)]
        x, y = np.ascontiguousarray((seen[:, :2] / seen[:, 2:]).T)
        shares.append(count_visible(x, y, int(number[0]), arrays) / len(points))
    return shares[0], shares[1]


def marker_truth(
    camera: Camera, surfaces: Sequence[Surface], which: int, marker: tuple[str, int, float],
    arrays: SurfaceArrays,
) -> MarkerTruth:  # fmt: skip
    """The truth of a marker (dictionary, number, width), but for its contrast, which is 0.

    The other parameters are those of `visible_shares`.
    """
    pose, width_m = surfaces[which].pose, marker[2]
    corners = marker_corners(camera, pose, width_m)
    return MarkerTruth(
        *marker[:2], corners, pose, width_m, mean_side_px(corners), slant_deg(pose), 0.0,
        *visible_shares(camera, surfaces, which, width_m, arrays),
    )  # fmt: skip
