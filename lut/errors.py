"""Exceptions of the package `lut`."""

from __future__ import annotations

from redetect.storage.messages import OneLineError


class TableError(OneLineError, ValueError):
    """A table that cannot be computed; the message names the quantity and what was expected."""
