"""What can be wrong with a camera."""

from __future__ import annotations


class CameraError(ValueError):
    """A camera that cannot be, or a calibration file that cannot be read.

    The message names the file and line where there is one, the quantity, its value and what was
    expected.
    """
