"""Writing of images, lines of text and truth, as all simulators do it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2

from redetect.array_types import ByteArray
from redetect.storage import write_bytes


def encoded(grey: ByteArray, ending: str = ".jpg", quality: int = 95) -> bytes:
    """The content of a grey image's file; `quality` is that of a JPEG."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if ending == ".jpg" else []
    done, content = cv2.imencode(ending, grey, options)
    if not done:
        raise ValueError(f"an image of {grey.shape} could not be encoded as {ending}")
    return bytes(content)


def write_lines(path: Path, lines: Iterable[str], *, overwrite: bool) -> None:
    """Write lines of text."""
    write_bytes(path, "".join(f"{line}\n" for line in lines).encode(), overwrite=overwrite)


def write_truth(
    path: Path, head: Mapping[str, Any], lists: Mapping[str, Sequence[Any]], *, overwrite: bool
) -> None:
    """Write the truth as a JSON object: a head, then lists with one line per item."""
    text = json.dumps(head, indent=1)[:-2]
    for key, items in lists.items():
        body = ",\n".join(json.dumps(item, separators=(",", ":")) for item in items)
        text += f',\n "{key}": [\n{body}\n ]'
    write_bytes(path, f"{text}\n}}\n".encode(), overwrite=overwrite)


def rounded(values: Any, digits: int) -> list[float]:
    """Numbers as Python's floats, with a number of digits after the point."""
    return [round(float(v), digits) for v in values]
