"""Exceptions of the package `camera`."""

from __future__ import annotations

from redetect.messages import OneLineError


class CameraError(OneLineError, ValueError):
    """An impossible camera, or a calibration file that cannot be read.

    The message names file and line if there are any, the quantity, its value, what was expected.
    """


class CalibrationError(CameraError):
    """A calibration that fails with these pictures; the message states what to do."""


class ConversionError(CameraError):
    """A calibration in another program's format that cannot be read, written or converted."""
