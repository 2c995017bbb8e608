"""Landmarks from robot images: discs on the floor and verticals, with covariances.

>>> import redetect as rd
>>> camera = rd.Camera.read("images/e/e.cam")                                  # doctest: +SKIP
>>> found = rd.detect("images/e/images/e.0000.png", camera, radius_m=0.10)     # doctest: +SKIP
>>> found.discs.xy, found.discs.covariance                                     # doctest: +SKIP

What is listed in `__all__` is the public interface; each name is imported when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from redetect.storage.version import __version__ as __version__

if TYPE_CHECKING:
    from camera import Camera
    from detect.line_settings import LineSettings
    from detect.settings import CircleSettings
    from detect.viewing_options import CompareOptions
    from redetect.library.detection import Detection, detect
    from redetect.library.explanation import Explanation, explain
    from redetect.library.maps import Localization, RunMap, localize
    from redetect.library.maps import map_landmarks as map
    from redetect.library.recordings import Recording, compare
    from redetect.library.recordings import open_recording as open
    from redetect.storage.messages import OneLineError as Error

_PLACES = {
    "Camera": ("camera", "Camera"),
    "CircleSettings": ("detect.settings", "CircleSettings"),
    "CompareOptions": ("detect.viewing_options", "CompareOptions"),
    "Detection": ("redetect.library.detection", "Detection"),
    "Error": ("redetect.storage.messages", "OneLineError"),
    "Explanation": ("redetect.library.explanation", "Explanation"),
    "LineSettings": ("detect.line_settings", "LineSettings"),
    "Localization": ("redetect.library.maps", "Localization"),
    "Recording": ("redetect.library.recordings", "Recording"),
    "RunMap": ("redetect.library.maps", "RunMap"),
    "compare": ("redetect.library.recordings", "compare"),
    "detect": ("redetect.library.detection", "detect"),
    "explain": ("redetect.library.explanation", "explain"),
    "localize": ("redetect.library.maps", "localize"),
    "map": ("redetect.library.maps", "map_landmarks"),
    "open": ("redetect.library.recordings", "open_recording"),
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
