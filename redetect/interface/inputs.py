"""Arguments of the API that are not what they should be, and the words of its errors."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from redetect.messages import OneLineError, excerpt

#: A command in backquotes, which keeps its flags, or a flag.
_FLAG = re.compile(r"(`[^`]*`)|(?<![\w/-])--([a-z][a-z-]*)")


def path_of(value: Any, expected: str, error: type[Exception]) -> Path:
    """A path; an error with what was expected if the value is none."""
    if not isinstance(value, str | os.PathLike):
        raise error(f"{excerpt(value)}: expected {expected}")
    return Path(value)


@contextmanager
def keywords_named() -> Iterator[None]:
    """Errors of a function that name flags, `--image-topic`, name its keywords, `image_topic`."""
    try:
        yield
    except OneLineError as error:
        error.args = (_FLAG.sub(_keyword, str(error)),)
        raise


def _keyword(found: re.Match[str]) -> str:
    return found[1] or f"`{found[2].replace('-', '_')}`"
