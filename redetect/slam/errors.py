"""Exceptions of the package `slam`."""

from __future__ import annotations

from redetect.messages import OneLineError


class SlamError(OneLineError, ValueError):
    """A run, map or setting that cannot be used.

    The message names the file, step, landmark or setting, its value and what was expected.
    """
