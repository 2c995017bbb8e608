"""Text files: read with a bound on their size."""

from __future__ import annotations

import os

from redetect.groundtruth.errors import StreamError
from redetect.storage.bounded import read_bounded


def read_text(path: str | os.PathLike[str], largest_bytes: int, expected: str) -> str:
    """The text of a file (UTF-8, perhaps with a byte order mark).

    Parameters
    ----------
    path : path
    largest_bytes : int
        A larger file is refused.
    expected : str
        What should be in it, for the message about a file that is no text.

    Raises
    ------
    StreamError
        If it cannot be read or is no text.
    """
    try:
        return read_bounded(path, largest_bytes).decode("utf-8-sig")
    except FileNotFoundError:
        raise StreamError(path, None, "no such file") from None
    except UnicodeDecodeError:
        raise StreamError(path, None, f"is no text: expected {expected}") from None
    except OSError as error:
        raise StreamError(path, None, f"cannot be read: {error.strerror}") from None
