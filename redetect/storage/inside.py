"""Checks names of files that other files give: they must not lead out of a given folder."""

from __future__ import annotations

import os
import posixpath
import re
from pathlib import Path

_DRIVE = re.compile(r"[A-Za-z]:")
#: What Windows takes for a device in any folder, whatever the ending.
_DEVICE = re.compile(
    r"(?:\A|/)(?:con|prn|aux|nul|com[0-9]|lpt[0-9])(?: *\.[^/]*)?(?:/|\Z)", re.IGNORECASE
)


def leads_out(name: str, *folders: str) -> str | None:
    r"""Why a name may not be taken for one of a file within a folder, by its letters alone.

    Parameters
    ----------
    name : str
        With / or \ between folders.
    folders : str
        Absolute paths of folders in any of which the file may be; without them any folder will do,
        and its name is not known.

    Returns
    -------
    str or None
        What is wrong with the name, as the end of a message that starts with it; None if nothing.
    """
    parts = name.replace("\\", "/")
    if "\0" in name:
        return "has a NUL in it"
    if parts.startswith("/") or _DRIVE.match(parts):
        return "is an absolute path"
    if ".." in parts and not any(
        _within(posixpath.normpath(f"{home}/{parts}"), home) for home in folders or ("/any/folder",)
    ):
        return "leads out of the folder"
    if _DEVICE.search(parts):
        return "is the name of a device"
    return None


def link_out(path: Path, *folders: Path) -> bool:
    """Whether a path is in none of the folders, after all links are resolved."""
    real = os.path.realpath(path)
    return not any(real == home or _within(real, home) for home in map(os.path.realpath, folders))


def path_inside(folder: Path, name: str) -> Path:
    """Path of a file that another file names, in the other file's folder.

    Raises
    ------
    ValueError
        If it would be elsewhere; the message says why, as the end of one that starts with the name.
    """
    why = leads_out(name)
    if why is None and link_out(folder / name, folder):
        why = "is a link that leads out of the folder"
    if why is not None:
        raise ValueError(why)
    return folder / name


def _within(path: str, folder: str) -> bool:
    return path.startswith(folder.rstrip("/") + "/")
