"""Exceptions of the package `camera`."""

from __future__ import annotations

from redetect.storage.messages import OneLineError


class CameraError(OneLineError, ValueError):
    """A camera that cannot be, or a calibration file that cannot be read.

    The message names the file and line where there is one, the quantity, its value and what was
    expected.
    """


class CalibrationError(CameraError):
    """A calibration that the pictures do not allow; the message says what to do next."""


class ConversionError(CameraError):
    """A calibration in another program's format that cannot be read, written or converted."""
