"""Landmarks from robot images: discs on the floor and verticals, with covariances.

>>> import redetect as rd
>>> camera = rd.Camera.read("images/e/e.cam")                                  # doctest: +SKIP
>>> found = rd.detect("images/e/images/e.0000.png", camera, radius_m=0.10)     # doctest: +SKIP
>>> found.discs.xy, found.discs.covariance                                     # doctest: +SKIP
>>> found.to_dataframe()                                                       # doctest: +SKIP

`__all__` is the public interface; each name is imported when first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

#: The version of this project, defined only here.
__version__ = "0.1.0"

if TYPE_CHECKING:
    from camera import Camera
    from detect.line_settings import LineSettings
    from detect.options import CompareOptions
    from detect.settings import CircleSettings
    from redetect.interface.detection import Detection, Explanation, detect, explain
    from redetect.interface.maps import Localization, RunMap, localize
    from redetect.interface.maps import map_landmarks as map
    from redetect.interface.recordings import Recording, compare
    from redetect.interface.recordings import open_recording as open
    from redetect.messages import OneLineError as Error

_PLACES = {
    "Camera": ("camera", "Camera"),
    "CircleSettings": ("detect.settings", "CircleSettings"),
    "CompareOptions": ("detect.options", "CompareOptions"),
    "Detection": ("redetect.interface.detection", "Detection"),
    "Error": ("redetect.messages", "OneLineError"),
    "Explanation": ("redetect.interface.detection", "Explanation"),
    "LineSettings": ("detect.line_settings", "LineSettings"),
    "Localization": ("redetect.interface.maps", "Localization"),
    "Recording": ("redetect.interface.recordings", "Recording"),
    "RunMap": ("redetect.interface.maps", "RunMap"),
    "compare": ("redetect.interface.recordings", "compare"),
    "detect": ("redetect.interface.detection", "detect"),
    "explain": ("redetect.interface.detection", "explain"),
    "localize": ("redetect.interface.maps", "localize"),
    "map": ("redetect.interface.maps", "map_landmarks"),
    "open": ("redetect.interface.recordings", "open_recording"),
}
__all__ = [
    "Camera",
    "CircleSettings",
    "CompareOptions",
    "Detection",
    "Error",
    "Explanation",
    "LineSettings",
    "Localization",
    "Recording",
    "RunMap",
    "__version__",
    "compare",
    "detect",
    "explain",
    "localize",
    "map",
    "open",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, own_name = _PLACES[name]
    value = getattr(import_module(module), own_name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
