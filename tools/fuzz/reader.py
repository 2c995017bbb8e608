"""Readers as fuzzing sees them, and the check that one behaves.

A reader has to return a result or raise a typed error whose message names the file, fits on one
line, has a bounded length and contains nothing that a terminal would act upon.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tools.published_camera import PUBLISHED_CAM

#: Numbers and signs that readers of text may stumble over.
NUMBERS = (b"nan", b"inf", b"1e308", b"-1e-320", b"1_0", b"0x1", b",", b"#", b"\\", b"\x1b[2J")

JSON_WORDS = (b"[", b"]", b"{", b"}", b'"', b":", b"null", b"true", b"1e999", b"NaN", b"-0")

NPZ_WORDS = (b"PK\x03\x04", b"PK\x01\x02", b"'descr': '|O'", b".npy", b"\xff\xff\xff\xff")

CAMERA_TEXT = PUBLISHED_CAM.encode()


def npz(**arrays: Any) -> bytes:
    """The content of a ``.npz`` of some arrays."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


#: Characters of a message beside the file's name.
LONGEST_MESSAGE = 500


@dataclass(frozen=True)
class Reader:
    """A reader, and the files and words with which its fuzzing begins."""

    name: str
    file: str  # Name of the file, which may include a folder.
    read: Callable[[Path], object]  # Reads a file, and asserts what the result must satisfy.
    errors: tuple[type[Exception], ...]  # What it may raise.
    seeds: tuple[bytes, ...] = ()  # Files that it accepts.
    words: tuple[bytes, ...] = ()  # Words of its language, from which files are composed.
    beside: Mapping[str, bytes] = field(default_factory=dict)
    """Other files that it needs in the same folder."""
    made_seeds: Callable[[], tuple[bytes, ...]] = tuple
    """Makes further files that it accepts, if that takes some time."""
    files: int = 150
    """Number of damaged files that the tests read: fewer if each takes milliseconds."""
    needed: bool = True  # Whether it is an error that there is no file.
    content: Callable[[bytes], bytes] = bytes
    """Makes the content of a file from bytes, if damaging the file itself would not lead far; seeds
    are then such bytes."""

    def all_seeds(self) -> tuple[bytes, ...]:
        """All files that it accepts."""
        return (*self.seeds, *self.made_seeds())

    def prepare(self, folder: Path) -> Path:
        """Write the other files that it needs into a folder; returns the path of its own file."""
        for name, content in self.beside.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)
        path = folder / self.file
        path.parent.mkdir(exist_ok=True)
        return path


def attempt(reader: Reader, path: Path) -> Exception | None:
    """Let a reader read a file: its typed error, if any; other exceptions pass through."""
    try:
        reader.read(path)
    except reader.errors as error:
        message = str(error)
        assert path.name in message or str(path.parent) in message, "names no file"
        beside_name = message.replace(str(path), "")
        assert message.isprintable(), f"control characters in a message: {message!a}"
        assert len(beside_name) <= LONGEST_MESSAGE, f"message of {len(beside_name)} characters"
        return error
    return None
