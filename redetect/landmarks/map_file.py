"""Files of landmark maps and paths: comma-separated, with a head that states their origin.

The joint covariance of a map's landmarks is in a file beside it.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.bounds import FINITE, LARGEST_NUMBER, number_in, whole_number_in
from redetect.landmarks.records import LandmarkFileError
from redetect.storage import demand_free, write_bytes
from redetect.storage.bounded import FilePath, read_bounded, read_plain_array

N = TypeVar("N", int, float)

#: Names of the files of a map and of a path in a folder of results.
MAP_NAME, PATH_NAME = "map.csv", "path.csv"

MAP_COLUMNS = ("kind", "id", "x_m", "y_m", "cxx_m2", "cxy_m2", "cyy_m2", "rows")
#: Columns of a map of discs with exact positions.
SHORT_MAP_COLUMNS = ("id", "x_m", "y_m", "rows")
PATH_COLUMNS = (
    *("prefix", "x_m", "y_m", "theta_rad"),
    *(f"c{row}{column}" for row in ("x", "y", "theta") for column in ("x", "y", "theta")),
)
#: Columns of a path without covariances.
SHORT_PATH_COLUMNS = PATH_COLUMNS[:4]
_LARGEST_FILE_BYTES = 1 << 28
# Both files of a map are written in full precision; sums may be in another order.
_SMALL_BYTES = 1 << 20
_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class MapLandmarks:
    """Landmarks of one kind in the map."""

    ids: IntArray  #: (M,) identifiers, each once
    xy: FloatArray  #: (M, 2) positions in the map (m)
    covariance: FloatArray  #: (M, 2, 2) of `xy` (m^2)
    rows: IntArray  #: (M,) number of rows from which each was estimated

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """Discs and vertical lines in one map."""

    discs: MapLandmarks
    lines: MapLandmarks
    #: (2 M, 2 M) of all positions, discs first (m^2); None if only each landmark's own is known
    joint_covariance: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Path2D:
    """The poses of a run: the start, and one after each step."""

    prefixes: tuple[str, ...]  #: Name of each pose; ``start`` for the start
    poses: FloatArray  #: (N, 3) x, y (m), theta (rad)
    covariance: FloatArray | None = None  #: (N, 3, 3) of the poses

    def part(self, first: int, end: int) -> Path2D:
        """The poses from index `first` up to, but not including, `end`."""
        spread = None if self.covariance is None else self.covariance[first:end]
        return Path2D(self.prefixes[first:end], self.poses[first:end], spread)


def no_landmarks() -> MapLandmarks:
    """An empty map."""
    return _landmarks({})


def write_map(
    path: FilePath,
    landmark_map: LandmarkMap,
    comments: Sequence[str] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Write a map with columns as `MAP_COLUMNS`, numbers in full precision.

    Its joint covariance, if there is one, is written beside it (`covariance_file`).

    Parameters
    ----------
    path : path
    landmark_map : LandmarkMap
    comments : sequence of str
        Lines for the head.
    overwrite : bool
        Whether an existing file may be replaced; else `redetect.storage.OutputExistsError`.
    """
    rows = [
        (kind, int(number), *map(float, (*xy, c[0, 0], c[0, 1], c[1, 1])), int(count))
        for kind, some in (("disc", landmark_map.discs), ("line", landmark_map.lines))
        for number, xy, c, count in zip(some.ids, some.xy, some.covariance, some.rows)
    ]
    write_table(path, MAP_COLUMNS, rows, comments, overwrite=overwrite)
    if landmark_map.joint_covariance is not None:
        content = io.BytesIO()
        np.save(content, np.ascontiguousarray(landmark_map.joint_covariance, dtype=np.float64))
        write_bytes(covariance_file(Path(path)), content.getvalue(), overwrite=overwrite)


def path_names(runs: int) -> list[str]:
    """Names of the files of paths of one or several runs."""
    return [PATH_NAME] if runs == 1 else [f"path_{k + 1}.csv" for k in range(runs)]


def write_map_and_paths(
    folder: Path,
    landmark_map: LandmarkMap,
    paths: Sequence[Path2D],
    comments: Sequence[str],
    *,
    overwrite: bool = False,
) -> None:
    """Write a map, and the paths of its runs, to a folder, which is created if necessary."""
    joint, names = covariance_file(folder / MAP_NAME), path_names(len(paths))
    demand_free([joint, *(folder / name for name in (MAP_NAME, *names))], overwrite=overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    write_map(folder / MAP_NAME, landmark_map, comments, overwrite=overwrite)
    if landmark_map.joint_covariance is None:
        # The file of an earlier map must not stay beside this one.
        joint.unlink(missing_ok=True)
    for name, path in zip(names, paths):
        write_path(folder / name, path, comments, overwrite=overwrite)


def read_map(path: FilePath) -> LandmarkMap:
    """Read a map written by `write_map`, or one made by hand with the same columns.

    The columns may also be `SHORT_MAP_COLUMNS`: discs with covariances of 0. The joint covariance
    is read by `with_joint_covariance`. Raises LandmarkFileError, with file and line, if the file
    cannot be read, a row is malformed, a landmark is listed twice or a covariance is negative.
    """
    found: dict[str, dict[int, tuple[list[float], int]]] = {"disc": {}, "line": {}}
    what = "a map: map.csv of `slam map`"
    for line, words in _read(path, what, MAP_COLUMNS, SHORT_MAP_COLUMNS):
        if len(words) == len(SHORT_MAP_COLUMNS):
            words = ["disc", *words[:3], "0", "0", "0", words[3]]
        kind = words[0]
        if kind not in found:
            raise LandmarkFileError(path, line, f"kind is {kind[:20]!r}: expected disc or line")
        number = _number(path, line, "id", words[1], whole_number_in)
        values = _finite(path, line, MAP_COLUMNS[2:7], words[2:7])
        rows = _number(path, line, "rows", words[7], whole_number_in)
        if number in found[kind]:
            raise LandmarkFileError(path, line, f"{kind} {number} is already in the map")
        _, _, cxx, cxy, cyy = values
        if cxx < 0.0 or cyy < 0.0 or cxy * cxy > 1.000001 * cxx * cyy:
            raise LandmarkFileError(path, line, f"{kind} {number}: covariance is negative")
        found[kind][number] = (values, rows)
    return LandmarkMap(discs=_landmarks(found["disc"]), lines=_landmarks(found["line"]))


def covariance_file(map_file: Path) -> Path:
    """Path of the joint covariance of a map: ``map_covariance.npy`` beside ``map.csv``.

    A map's own file contains only the covariance of each landmark. In a map made by driving,
    landmarks share most of their error with their neighbours (the drift from the start), which only
    the joint covariance describes.
    """
    return map_file.with_name(f"{map_file.stem}_covariance.npy")


def with_joint_covariance(landmark_map: LandmarkMap, map_file: Path) -> LandmarkMap:
    """A map with the joint covariance beside its file; unchanged if there is none.

    Raises LandmarkFileError if that is malformed, or of another map.
    """
    path = covariance_file(map_file)
    if not path.is_file():
        return landmark_map
    own = np.concatenate([landmark_map.discs.covariance, landmark_map.lines.covariance])
    shape = (2 * len(own), 2 * len(own))
    most_bytes = max(32 * len(own) ** 2, _SMALL_BYTES)
    try:
        with path.open("rb") as stream:
            found = read_plain_array(stream, np.dtype(np.float64), 2, most_bytes)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise LandmarkFileError(path, None, f"cannot be read: {reason}") from None
    if found.shape != shape:
        words = f"is of shape {found.shape}: expected {shape}, x and y of each one of {map_file}"
        raise LandmarkFileError(path, None, words)
    k = np.arange(len(own))
    blocks = found.reshape(len(own), 2, len(own), 2)[k, :, k, :]
    nearly = _SAME * float(np.max(np.abs(own), initial=0.0))
    if not (np.isfinite(found).all() and np.allclose(blocks, own, rtol=_SAME, atol=nearly)):
        raise LandmarkFileError(
            path, None, f"not the covariance of {map_file}: expected that of each landmark"
        )
    return replace(landmark_map, joint_covariance=0.5 * (found + found.T))


def write_path(
    path: FilePath, poses: Path2D, comments: Sequence[str] = (), *, overwrite: bool = False
) -> None:
    """Write a path with columns `PATH_COLUMNS`, the covariance row by row if there is one."""
    columns, table = SHORT_PATH_COLUMNS, poses.poses
    if poses.covariance is not None:
        columns = PATH_COLUMNS
        table = np.hstack([table, poses.covariance.reshape(-1, 9)])
    rows = [(prefix, *row) for prefix, row in zip(poses.prefixes, table.tolist())]
    write_table(path, columns, rows, comments, overwrite=overwrite)


def read_path(path: FilePath) -> Path2D:
    """Read a path written by `write_path`; errors are those of `read_map`."""
    prefixes, numbers = [], []
    what = "a path, path.csv, of `slam map`"
    for line, words in _read(path, what, PATH_COLUMNS, SHORT_PATH_COLUMNS):
        prefixes.append(words[0])
        numbers.append(_finite(path, line, PATH_COLUMNS[1:], words[1:]))
    table = np.array(numbers, dtype=np.float64)
    covariance = table[:, 3:].reshape(-1, 3, 3) if table.shape[1] > 3 else None
    return Path2D(tuple(prefixes), table[:, :3].copy(), covariance)


def _landmarks(found: dict[int, tuple[list[float], int]]) -> MapLandmarks:
    table = np.array([values for values, _ in found.values()], dtype=np.float64).reshape(-1, 5)
    return MapLandmarks(
        ids=np.array(list(found), dtype=np.int64),
        xy=table[:, :2].copy(),
        covariance=table[:, [2, 3, 3, 4]].reshape(-1, 2, 2),
        rows=np.array([rows for _, rows in found.values()], dtype=np.int64),
    )


def write_table(
    path: FilePath,
    columns: Sequence[str],
    rows: Sequence[Sequence[object]],
    comments: Sequence[str] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Write comma-separated rows after comments and a line of names; floats in full precision."""
    text = io.StringIO()
    text.writelines(f"# {comment}\n" for comment in comments)
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    write_bytes(path, text.getvalue().encode("utf-8", "surrogateescape"), overwrite=overwrite)


def _read(
    path: FilePath, what: str, columns: Sequence[str], fewer: Sequence[str]
) -> Iterator[tuple[int, list[str]]]:
    """Rows of a file with their line numbers, after a head with either set of columns."""
    try:
        text = read_bounded(path, _LARGEST_FILE_BYTES).decode("utf-8-sig", "surrogateescape")
    except OSError as error:
        reason = error.strerror or error
        raise LandmarkFileError(path, None, f"cannot be read: {reason}: expected {what}") from None
    head: list[str] = []
    empty = True
    for number, line in enumerate(text.split("\n"), 1):  # names may have other line ends
        if not line.strip() or line.startswith("#"):
            continue
        try:
            words = next(csv.reader([line]))
        except csv.Error as error:
            raise LandmarkFileError(path, number, str(error)) from None
        if not head:
            if tuple(words) not in (columns, fewer):
                raise LandmarkFileError(path, number, f"expected the columns {','.join(columns)}")
            head = words
            continue
        if len(words) != len(head):
            raise LandmarkFileError(path, number, f"{len(words)} values: expected {len(head)}")
        empty = False
        yield number, words
    if empty:
        raise LandmarkFileError(
            path, None, f"no rows: expected at least one under {','.join(columns)}"
        )


def _finite(path: FilePath, line: int, names: Sequence[str], words: Sequence[str]) -> list[float]:
    return [_number(path, line, name, word, number_in) for name, word in zip(names, words)]


def _number(path: FilePath, line: int, name: str, word: str, read: Callable[[str], N]) -> N:
    """A finite float, or an integer of 64 bits."""
    whole = (2**63, "a whole number")
    limit, expected = whole if read is whole_number_in else (LARGEST_NUMBER, FINITE.expected)
    try:
        value = read(word)
    except ValueError:
        value = None
    if value is None or not abs(value) < limit:
        raise LandmarkFileError(path, line, f"{name} is {word[:30]!r}: expected {expected}")
    return value
