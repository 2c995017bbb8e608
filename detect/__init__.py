"""From one image to landmarks, their comparison with a reference, the command line."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("redetect")
except PackageNotFoundError:  # a checkout that was never installed
    __version__ = "unknown"

__all__ = ["__version__"]
