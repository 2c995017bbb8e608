"""Results as tables: data frames, JSON, HTML; results with arrays are equal if all values are."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import Any, Literal, get_args

import numpy as np

from redetect.json_text import json_text, plain
from redetect.messages import OneLineError, excerpt

FrameLibrary = Literal["pandas", "polars"]

#: Number of rows that a notebook shows.
_MOST_SHOWN = 20


class ResultError(OneLineError, ValueError):
    """A result that cannot be converted to the requested form."""


class ByContent:
    """Base class of dataclasses with arrays: equal if all values are."""

    def __eq__(self, other: object) -> bool:
        return alike(self, other)

    __hash__ = None  # type: ignore[assignment]  # arrays may be changed


class Table(ByContent):
    """A result with columns; base class of all results."""

    def columns(self) -> dict[str, Sequence[Any]]:
        """Columns of equal length by name; names end with the unit."""
        raise NotImplementedError

    def records(self) -> list[dict[str, Any]]:
        """The rows as dicts with JSON's types."""
        columns = plain(self.columns())
        return [dict(zip(columns, values)) for values in zip(*columns.values())]

    def to_dataframe(self, library: FrameLibrary | None = None) -> Any:
        """The columns as a data frame.

        Parameters
        ----------
        library : "pandas" or "polars", optional
            By default the first of them that is installed.

        Raises
        ------
        redetect.tables.ResultError
            If it is not installed.
        """
        wanted = get_args(FrameLibrary) if library is None else (library,)
        for name in wanted:
            if name not in get_args(FrameLibrary):
                raise ResultError(f"library is {excerpt(name)}: expected pandas or polars")
            with suppress(ModuleNotFoundError):
                return import_module(name).DataFrame(self.columns())
        raise ResultError(
            f"{' or '.join(wanted)} is not installed: pip install {wanted[0]}, or use columns() "
            "or to_json()"
        )

    def to_json(self) -> str:
        """The columns as a JSON object of lists; numbers that are not finite are null."""
        return json_text(self.columns())

    def __repr__(self) -> str:
        columns = self.columns()
        rows = len(next(iter(columns.values())))
        return f"<{type(self).__name__}: {rows} rows of {', '.join(columns)}>"

    def _repr_html_(self) -> str:
        return html_picture(self) + html_table(self.columns())


def alike(one: Any, other: Any) -> bool:
    """Whether two values, arrays or records of such are equal; NaN equals NaN."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    if is_dataclass(one):
        compared = [field.name for field in fields(one) if field.compare]
        return all(alike(getattr(one, name), getattr(other, name)) for name in compared)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(alike, one, other))
    return bool(one == other or (one != one and other != other))


def covariance_columns(covariance: Any) -> dict[str, Sequence[Any]]:
    """Columns of (N, 2, 2) covariances of positions, square metres."""
    return dict(zip(("cxx_m2", "cxy_m2", "cyy_m2"), covariance[:, (0, 0, 1), (0, 1, 1)].T))


def html_picture(shown: Any) -> str:
    """What a notebook shows as a picture, if anything, as HTML with embedded content."""
    if not hasattr(shown, "_repr_png_"):
        return ""
    content = base64.b64encode(shown._repr_png_()).decode()
    return f'<img alt="{html.escape(repr(shown))}" src="data:image/png;base64,{content}"/>'


def html_table(columns: Mapping[str, Sequence[Any]]) -> str:
    """The first rows of a table as HTML."""
    count = len(next(iter(columns.values()), ()))
    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    rows = "".join(
        "<tr>" + "".join(f"<td>{_word(column[k])}</td>" for column in columns.values()) + "</tr>"
        for k in range(min(count, _MOST_SHOWN))
    )
    more = f"<p>and {count - _MOST_SHOWN} more rows</p>" if count > _MOST_SHOWN else ""
    return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>{more}"


def _word(value: Any) -> str:
    if isinstance(value, float | np.floating):
        return f"{value:.4g}" if math.isfinite(value) else ""
    return html.escape(str(value))
