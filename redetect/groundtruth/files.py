"""Text and JSON files: reading with a bound on their size; writing of readable JSON."""

from __future__ import annotations

import gzip
import io
import json
import os
import re
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from redetect.array_types import FloatArray
from redetect.bounds import FINITE, LARGEST_NUMBER, NUMBER, Bounds
from redetect.groundtruth.errors import GroundTruthError
from redetect.json_text import json_rows
from redetect.messages import excerpt, one_line
from redetect.storage import write_bytes
from redetect.storage.bounded import read_content

#: A file or folder by name.
PathLike = str | os.PathLike[str]

_LARGEST_FILE_BYTES = 1 << 26
_ROUNDING = 1e-6
_DIGITS = re.compile(r"[-+0-9.eE]*")


def read_json(path: PathLike) -> dict[str, Any]:
    """Read a file with a JSON object; raises `GroundTruthError` if it cannot be read or is none."""
    text = read_text(path, _LARGEST_FILE_BYTES, "JSON")
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise GroundTruthError(f"{path}:{error.lineno}: invalid JSON: {error.msg}") from None
    except RecursionError:
        raise GroundTruthError(f"{path}: invalid JSON: nested too deeply") from None
    except ValueError:  # Python converts no more than some thousand digits
        raise GroundTruthError(f"{path}: invalid JSON: a number is too long") from None
    if not isinstance(content, dict):
        raise GroundTruthError(f"{path}: expected a JSON object")
    return content


class JsonObject:
    """A JSON file's object; missing or wrong values raise `GroundTruthError` with their place."""

    def __init__(self, place: str, value: Any) -> None:
        if not isinstance(value, dict):
            raise GroundTruthError(f"{place}: expected an object")
        self.place, self.values = place, value

    @classmethod
    def read(cls, path: PathLike) -> JsonObject:
        """The object in a file."""
        return cls(os.fspath(path), read_json(path))

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def wrong(self, key: str, expected: str) -> GroundTruthError:
        """The error of a value that is not as expected."""
        found = excerpt(self.values.get(key))
        return GroundTruthError(f"{self.place}: {key} is {found}: expected {expected}")

    def demand_version(self) -> None:
        """Raise an error for versions other than 1."""
        if self.values.get("version") != 1:
            raise self.wrong("version", "1")

    def text(self, key: str, expected: str = "a text") -> str:
        """A text that is not empty."""
        value = self.values.get(key)
        if not isinstance(value, str) or not value:
            raise self.wrong(key, expected)
        return value

    def number(self, key: str, bounds: Bounds = FINITE) -> float:
        """A number within bounds."""
        value = self.values.get(key)
        if not is_number(value) or not bounds.contain(value):
            raise self.wrong(key, bounds.expected)
        return float(value)

    def whole(self, key: str) -> int:
        """A whole number."""
        value = self.values.get(key)
        if not isinstance(value, int) or isinstance(value, bool):
            raise self.wrong(key, "a whole number")
        return value

    def numbers(self, key: str, *shape: int | None) -> FloatArray:
        """Nested lists of numbers as an array; None: any length."""
        value = self.values.get(key)
        if not _has_shape(value, shape):
            expected = " x ".join("rows" if size is None else str(size) for size in shape)
            raise self.wrong(key, f"{expected} finite numbers")
        return np.array(value, dtype=np.float64)

    def inner(self, key: str) -> JsonObject:
        """An object."""
        return JsonObject(f"{self.place}: {key}", self.values.get(key))

    def rows(self, key: str) -> list[JsonObject]:
        """A list of objects that is not empty."""
        value = self.values.get(key)
        if not isinstance(value, list) or not value or not all(isinstance(v, dict) for v in value):
            raise self.wrong(key, "a list of objects")
        return [JsonObject(f"{self.place}: {key}[{i}]", row) for i, row in enumerate(value)]

    def objects(self, key: str) -> dict[str, JsonObject]:
        """Objects by their names, at least one."""
        value = self.values.get(key)
        if not isinstance(value, dict) or not value:
            raise self.wrong(key, "an object with at least one entry")
        kind = f"{self.place}: {key.removesuffix('s')}"
        return {name: JsonObject(f"{kind} {one_line(name, 60)}", v) for name, v in value.items()}

    def covariance(self, key: str, size: int) -> FloatArray:
        """A covariance (size, size)."""
        place = f"{self.place}: {key}"
        matrix = self.numbers(key, size, size)
        scale = np.sqrt(np.clip(np.diagonal(matrix), 0.0, None))
        safe = np.where(scale > 0.0, scale, 1.0)
        correlation = matrix / safe[:, None] / safe[None, :]
        if np.abs(correlation - correlation.T).max() > _ROUNDING:
            raise GroundTruthError(f"{place}: expected a symmetric matrix")
        if np.linalg.eigvalsh(correlation)[0] < -_ROUNDING:
            raise GroundTruthError(f"{place}: has a negative eigenvalue: expected a covariance")
        return np.asarray(0.5 * (matrix + matrix.T))

    def joint_covariance(self, key: str, names: Sequence[str], size: int) -> FloatArray:
        """(size N, size N) covariance of all N `names`, in their order: the object `covariance`,
        which lists them, in any order, as `key` beside its matrix.
        """
        joint = self.values.get("covariance")
        if not isinstance(joint, dict) or not isinstance(joint.get(key), list):
            raise self.wrong("covariance", f"an object with {key} and matrix")
        place, order = f"{self.place}: covariance", [str(name) for name in joint[key]]
        if sorted(order) != sorted(names):
            raise GroundTruthError(
                f"{place}: {key} are {excerpt(order)}: expected {excerpt(list(names))}"
            )
        matrix = JsonObject(place, joint).covariance("matrix", size * len(names))
        index = np.concatenate([size * order.index(name) + np.arange(size) for name in names])
        return np.asarray(matrix[np.ix_(index, index)])

    def uncertainty(self, size: int, sigmas: str = "sigmas") -> FloatArray:
        """(size, size) covariance by `covariance`, or by standard deviations, named by `sigmas`, in
        the order of its rows; else zeros.
        """
        if "covariance" in self and sigmas in self:
            raise GroundTruthError(
                f"{self.place}: has covariance and {sigmas}: expected one of them"
            )
        if "covariance" in self:
            return self.covariance("covariance", size)
        values = self.numbers(sigmas, size) if sigmas in self else np.zeros(size)
        if np.any(values < 0.0):
            raise GroundTruthError(f"{self.place}: {sigmas}: expected 0 or more")
        return np.diag(values**2)


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value from JSON is a usable number."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= LARGEST_NUMBER  # NaN fails this; a whole number may fit no double


def _has_shape(value: Any, shape: tuple[int | None, ...]) -> bool:
    if not shape:
        return is_number(value)
    if not isinstance(value, list) or shape[0] not in (None, len(value)):
        return False
    return all(_has_shape(part, shape[1:]) for part in value)


def write_json(path: PathLike, content: Mapping[str, Any], *, overwrite: bool = False) -> None:
    """Write a JSON object with a line per entry of its objects, whole or not at all."""
    write_bytes(path, f"{json_rows(content)}\n".encode(), overwrite=overwrite)


def read_text(path: PathLike, largest_bytes: int, expected: str) -> str:
    """The text of a file (UTF-8, perhaps with a byte order mark), packed (``.gz``) or not.

    `largest_bytes`: larger files are rejected. `expected`: the expected content, for the message
    about a file that is not text.
    """
    content = read_content(path, largest_bytes, "file", GroundTruthError)
    try:
        if Path(path).suffix == ".gz":
            # Bounded, whatever the compression ratio.
            content = gzip.GzipFile(fileobj=io.BytesIO(content)).read(largest_bytes + 1)
            if len(content) > largest_bytes:
                raise GroundTruthError(f"{path}: unpacked, it has more than {largest_bytes} bytes")
        return content.decode("utf-8-sig")
    except (gzip.BadGzipFile, EOFError, zlib.error):
        raise GroundTruthError(f"{path}: incomplete or damaged gzip file") from None
    except UnicodeDecodeError:
        raise GroundTruthError(f"{path}: not text: expected {expected}") from None


def read_rows(path: PathLike, largest_bytes: int = 1 << 28) -> Iterator[tuple[int, list[str]]]:
    """Yield line numbers and words, without commas, comments and blank lines."""
    for number, line in enumerate(read_text(path, largest_bytes, "rows of numbers").split("\n"), 1):
        content = line.partition("#")[0].strip()
        if content:
            blanks = len(content.split(None, 1)) > 1
            # Rows of hundreds of readings have only commas, which is four times faster.
            yield number, re.split(r"\s*,\s*|\s+", content) if blanks else content.split(",")


class TableRow(NamedTuple):
    """A row of a table."""

    line: int  # In the file, counted from 1
    words: list[str]  # Of the columns with words
    numbers: list[float]  # Of the others; finite


def read_table(path: PathLike, head: str, words: Collection[str] = ()) -> list[TableRow]:
    """Rows separated by commas or blanks after an optional head.

    `head` are the comma-separated names of the columns, `words` those with words; the others have
    finite numbers. Raises `GroundTruthError` with file and line if a row is malformed.
    """
    names = head.split(",")
    rows: list[TableRow] = []
    for line, found in read_rows(path):
        if not rows and found == names:
            continue
        if len(found) != len(names):
            raise GroundTruthError(f"{path}:{line}: {len(found)} words: expected {head}")
        texts = [word for name, word in zip(names, found) if name in words]
        numbers = [word for name, word in zip(names, found) if name not in words]
        rows.append(TableRow(line, texts, parse_numbers(path, line, numbers)))
    return rows


def known_name(path: PathLike, line: int, name: str, known: Collection[str]) -> str:
    """A word of a row, which must be one of those known."""
    if name not in known:
        raise GroundTruthError(
            f"{path}:{line}: {excerpt(name)}: expected one of {', '.join(known)}"
        )
    return name


def parse_numbers(
    path: PathLike, line: int, words: list[str], below: float = LARGEST_NUMBER
) -> list[float]:
    """The words of a row as finite numbers, within a bound."""
    try:
        # One expression for all words: rows of scans have hundreds. It keeps out 1_0, nan and inf.
        if _DIGITS.fullmatch("".join(words)):
            values = [float(word) for word in words]
            if max(map(abs, values), default=0.0) < below:
                return values
    except ValueError:
        pass
    fit = (re.fullmatch(NUMBER, w) and abs(float(w)) < below for w in words)
    wrong = next(word for word, fits in zip(words, fit) if not fits)
    expected = FINITE.expected if below <= LARGEST_NUMBER else "a finite number"
    raise GroundTruthError(f"{path}:{line}: {excerpt(wrong)}: expected {expected}")
