"""What stands at the head of a file of rows: how they were made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from detect.circles_run import LEVELLED
from detect.errors import DetectError
from detect.settings import CircleSettings
from detect.tune_grid import parameter_value

# The head is what stands before the first row; nobody writes so much.
_LONGEST_BYTES = 1 << 16


@dataclass(frozen=True)
class FileHead:
    """The head of a file of rows, as far as it is understood.

    Attributes
    ----------
    comments : tuple of str
        Its lines without the signs of comment.
    settings : dict of str
        The effective settings, by name, as they are written.
    levelled : bool
        Whether it says that positions of discs are corrected for the frames' tilts.
    """

    comments: tuple[str, ...] = ()
    settings: tuple[tuple[str, str], ...] = ()
    levelled: bool = False

    @property
    def circle_settings(self) -> CircleSettings:
        """The settings of discs, the defaults where the head does not tell them.

        Raises
        ------
        DetectError
            If one has a value that none can have.
        """
        known = set(CircleSettings.__dataclass_fields__)
        values = {
            name: parameter_value(CircleSettings, name, text)
            for name, text in self.settings
            if name in known
        }
        return CircleSettings(**values)


def read_head(path: Path) -> FileHead:
    """Read the head of a file of rows.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    FileHead

    Raises
    ------
    DetectError
        If the file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            start = stream.read(_LONGEST_BYTES)
    except OSError as error:
        raise DetectError(f"{path}: cannot be read: {error.strerror}") from None
    comments: list[str] = []
    for line in start.decode("utf-8", "replace").splitlines():
        text = line.strip()
        if text and not text.startswith("#"):
            break
        comments.append(text.removeprefix("#").strip())
    settings = tuple(
        (name, value)
        for text in comments
        if text.startswith("settings ")
        for name, equals, value in (word.partition("=") for word in text.split()[1:])
        if equals
    )
    return FileHead(tuple(comments), settings, any(LEVELLED in text for text in comments))
