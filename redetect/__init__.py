"""Landmarks from robot images: discs on the floor and verticals, with covariances.

>>> import redetect as rd
>>> camera = rd.Camera.read("images/e/e.cam")                                  # doctest: +SKIP
>>> found = rd.detect("images/e/images/e.0000.jpg", camera, radius_m=0.10)     # doctest: +SKIP
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
    "camera": ["Camera"],
    "detect.line_settings": ["LineSettings"],
    "detect.options": ["CompareOptions"],
    "detect.settings": ["CircleSettings"],
    "redetect.interface.detection": ["Detection", "Explanation", "detect", "explain"],
    "redetect.interface.maps": ["Localization", "RunMap", "localize", "map"],
    "redetect.interface.recordings": ["Recording", "compare", "open"],
    "redetect.messages": ["Error"],
}
_OWN_NAMES = {"Error": "OneLineError", "map": "map_landmarks", "open": "open_recording"}
__all__ = [
    "Camera", "CircleSettings", "CompareOptions", "Detection", "Error", "Explanation",
    "LineSettings", "Localization", "Recording", "RunMap", "__version__", "compare", "detect",
    "explain", "localize", "map", "open",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    for module, names in _PLACES.items():
        if name in names:
            value = getattr(import_module(module), _OWN_NAMES.get(name, name))
            return globals().setdefault(name, value)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
