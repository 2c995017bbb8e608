"""Text and JSON files: read with a bound on their size; JSON written in lines people can read."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

from redetect.groundtruth.errors import GroundTruthError, StreamError
from redetect.storage import write_whole
from redetect.storage.bounded import read_bounded

_LARGEST_FILE_BYTES = 1 << 26


def read_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a file that holds a JSON object.

    Raises
    ------
    GroundTruthError
        If it cannot be read or is none.
    """
    content = read_json_value(path)
    if not isinstance(content, dict):
        raise GroundTruthError(f"{path}: expected a JSON object")
    return content


def read_json_value(path: str | os.PathLike[str]) -> Any:
    """Read a file that holds JSON, whatever its value is.

    Raises
    ------
    GroundTruthError
        If it cannot be read or is no JSON.
    """
    try:
        return json.loads(read_bounded(path, _LARGEST_FILE_BYTES).decode("utf-8-sig"))
    except FileNotFoundError:
        raise GroundTruthError(f"{path}: no such file") from None
    except json.JSONDecodeError as error:
        raise GroundTruthError(f"{path}:{error.lineno}: is no JSON: {error.msg}") from None
    except RecursionError:
        raise GroundTruthError(f"{path}: is no JSON that can be read: nested too deep") from None
    except UnicodeDecodeError:
        raise GroundTruthError(f"{path}: is no text: expected JSON") from None
    except ValueError:  # Python converts no more than some thousand digits
        raise GroundTruthError(f"{path}: is no JSON that can be read: a number too long") from None
    except OSError as error:
        raise GroundTruthError(f"{path}: cannot be read: {error.strerror}") from None


def write_json(
    path: str | os.PathLike[str], content: Mapping[str, Any], *, overwrite: bool = False
) -> None:
    """Write a JSON object with a line per entry of its objects, whole or not at all."""
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write((_laid_out(content) + "\n").encode())


def _laid_out(value: Any, indent: str = "") -> str:
    """JSON with objects over several lines and arrays on one, except matrices: a line per row."""
    deeper = indent + " "
    if isinstance(value, Mapping) and value:
        items = (f"{deeper}{json.dumps(k)}: {_laid_out(v, deeper)}" for k, v in value.items())
        return "{\n" + ",\n".join(items) + f"\n{indent}}}"
    if isinstance(value, list | tuple) and value and isinstance(value[0], list | tuple | Mapping):
        return "[\n" + ",\n".join(deeper + _laid_out(v, deeper) for v in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False)


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
