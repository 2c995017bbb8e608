"""Exceptions of the package `groundtruth`."""

from __future__ import annotations

from redetect.messages import OneLineError


class GroundTruthError(OneLineError, ValueError):
    """A session, calibration or setting that cannot be used.

    The message names the file, frame or setting, its value and what was expected.
    """


class GeometryError(OneLineError, ValueError):
    """Observations that do not determine a pose; only their frame is affected."""
