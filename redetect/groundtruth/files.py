"""Text and JSON files: read with a bound on their size; JSON written in lines people can read."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any, TypeGuard

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError, StreamError
from redetect.storage import write_whole
from redetect.storage.bounded import read_bounded
from redetect.storage.messages import excerpt

_LARGEST_FILE_BYTES = 1 << 26
_LARGEST_NUMBER = 1e100
_ROUNDING = 1e-6


def read_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a file that holds a JSON object.

    Raises
    ------
    GroundTruthError
        If it cannot be read or is none.
    """
    text = read_text(path, _LARGEST_FILE_BYTES, "JSON")
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise GroundTruthError(f"{path}:{error.lineno}: is no JSON: {error.msg}") from None
    except RecursionError:
        raise GroundTruthError(f"{path}: is no JSON that can be read: nested too deep") from None
    except ValueError:  # Python converts no more than some thousand digits
        raise GroundTruthError(f"{path}: is no JSON that can be read: a number too long") from None
    if not isinstance(content, dict):
        raise GroundTruthError(f"{path}: expected a JSON object")
    return content


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value from JSON is a number that can be worked with."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= _LARGEST_NUMBER  # NaN fails this; a whole number may fit no double


def numbers(place: str, value: Any, *shape: int | None) -> FloatArray:
    """Numbers, or nested lists of them, as an array; None: any length."""
    if not _has_shape(value, shape):
        expected = " x ".join("rows" if size is None else str(size) for size in shape)
        what = f"{expected} finite numbers" if shape else "a finite number"
        raise GroundTruthError(f"{place} is {excerpt(value)}: expected {what}")
    return np.array(value, dtype=np.float64)


def _has_shape(value: Any, shape: tuple[int | None, ...]) -> bool:
    if not shape:
        return is_number(value)
    if not isinstance(value, list) or shape[0] not in (None, len(value)):
        return False
    return all(_has_shape(part, shape[1:]) for part in value)


def covariance_of(place: str, value: Any, size: int) -> FloatArray:
    """A covariance (size, size) from JSON."""
    matrix = numbers(place, value, size, size)
    scale = np.sqrt(np.clip(np.diagonal(matrix), 0.0, None))
    safe = np.where(scale > 0.0, scale, 1.0)
    correlation = matrix / safe[:, None] / safe[None, :]
    if np.abs(correlation - correlation.T).max() > _ROUNDING:
        raise GroundTruthError(f"{place}: expected a symmetric matrix")
    if np.linalg.eigvalsh(correlation)[0] < -_ROUNDING:
        raise GroundTruthError(f"{place}: has a negative eigenvalue: expected a covariance")
    return np.asarray(0.5 * (matrix + matrix.T))


def covariance_entry(
    place: str, entry: Mapping[str, Any], size: int, sigmas: str = "sigmas"
) -> FloatArray:
    """(size, size) covariance of an object with ``covariance`` or standard deviations; else zeros.

    The latter are named by `sigmas`; both are in the order of the covariance's rows.
    """
    if "covariance" in entry and sigmas in entry:
        raise GroundTruthError(f"{place}: has covariance and {sigmas}: expected one of them")
    if sigmas in entry:
        values = numbers(f"{place}: {sigmas}", entry[sigmas], size)
        if np.any(values < 0.0):
            raise GroundTruthError(f"{place}: {sigmas}: expected 0 or more")
        return np.diag(values**2)
    if "covariance" in entry:
        return covariance_of(f"{place}: covariance", entry["covariance"], size)
    return np.zeros((size, size))


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

    `largest_bytes`: a larger file is refused. `expected`: what should be in it, for the message
    about a file that is no text.
    """
    try:
        return read_bounded(path, largest_bytes).decode("utf-8-sig")
    except FileNotFoundError:
        raise StreamError(path, None, "no such file") from None
    except UnicodeDecodeError:
        raise StreamError(path, None, f"is no text: expected {expected}") from None
    except OSError as error:
        raise StreamError(path, None, f"cannot be read: {error.strerror}") from None
