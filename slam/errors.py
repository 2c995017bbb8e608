"""What can be wrong with a run that is to be mapped or localised in."""

from __future__ import annotations

from storage.messages import OneLineError


class SlamError(OneLineError, ValueError):
    """A run, map or setting that cannot be worked on.

    The message names the file, step, landmark or setting, its value and what was expected.
    """
