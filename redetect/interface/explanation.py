"""Why discs were found in an image, or not."""

from __future__ import annotations

import base64
import html
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.discs.unfound import Candidate, DiscExplanation, explain_discs
from detect.drawing.frame import draw_disc_candidates, png_of
from detect.settings import CircleSettings, Polarity
from detect.sources.interface import read_image
from redetect.interface.detection import (
    CameraLike,
    ImageLike,
    camera_of,
    frame_of_image,
    settings_of,
)
from redetect.interface.tables import Table


@dataclass(frozen=True, eq=False, repr=False)
class Explanation(Table):
    """Candidates of an image with the stage and the number that dropped them, and what to try.

    Attributes
    ----------
    candidates : tuple of detect.discs.unfound.Candidate
        Those that were found first, then by falling quality.
    place : str
        Of the pixel that was pointed at; empty without one.
    suggestions : tuple of str
        Flags or settings to try, and what they would find.
    """

    candidates: tuple[Candidate, ...]
    place: str
    suggestions: tuple[str, ...]
    image: NDArray[np.uint8]
    camera: Camera
    settings: CircleSettings
    at: tuple[float, float] | None

    def columns(self) -> dict[str, Any]:
        """One row per candidate, numbered as in the picture."""
        rows = self.candidates
        fields = ("u", "v", "x_m", "y_m", "quality", "contrast", "stage", "value", "limit")
        return {
            "number": list(range(1, len(rows) + 1)),
            **{name: [getattr(row, name) for row in rows] for name in fields},
            "reason": [row.reason() for row in rows],
        }

    def to_json(self) -> str:
        """An object with `candidates` (a list of records), `place` and `suggestions`."""
        return DiscExplanation(self.candidates, self.place, self.suggestions).to_json()

    def picture(self) -> NDArray[np.uint8]:
        """(H + h, W, 3) the image with its candidates, in OpenCV's order blue, green, red."""
        return draw_disc_candidates(
            self.image, self.camera, self.settings.radius_m, self.candidates, self.at
        )

    def __str__(self) -> str:
        lines = [self.place] if self.place else []
        lines += [
            f"{number:3d}  ({row.u:.0f}, {row.v:.0f})  {row.reason()}"
            for number, row in enumerate(self.candidates, start=1)
        ]
        return "\n".join([*lines, *self.suggestions])

    def _repr_png_(self) -> bytes:
        return png_of(self.picture())

    def _repr_html_(self) -> str:
        picture = base64.b64encode(self._repr_png_()).decode()
        words = "".join(f"<p>{html.escape(w)}</p>" for w in (self.place, *self.suggestions) if w)
        return f'{words}<img alt="" src="data:image/png;base64,{picture}"/>' + super()._repr_html_()


def explain(
    image: ImageLike,
    camera: CameraLike,
    at: tuple[float, float] | None = None,
    radius_m: float | None = None,
    polarity: Polarity | None = None,
    *,
    settings: CircleSettings | None = None,
) -> Explanation:
    """Explain what became of the candidates for discs in an image.

    Parameters
    ----------
    image, camera, radius_m, polarity, settings
        As of `redetect.interface.detection.detect`.
    at : (float, float), optional
        Pixel (u, v) of something that should have been found.

    Returns
    -------
    Explanation

    Raises
    ------
    detect.errors.FrameError
        If the image cannot be read, is no grey image of 8 bits, or not of the camera's size.
    camera.CameraError
        If the calibration cannot be read.
    """
    frame, camera = frame_of_image(image), camera_of(camera)
    chosen = settings_of(settings, radius_m, polarity)
    pixels = read_image(frame, camera)
    found = explain_discs(pixels, camera, chosen, at)
    return Explanation(found.candidates, found.place, found.suggestions, pixels, camera, chosen, at)
