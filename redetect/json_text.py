"""JSON of results and files, all of it with the same types.

Entries keep their order. Arrays and tuples are lists, records are objects, and paths are text.
Numbers that are not finite are null, since JSON has none; others are exact in the shortest form.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import numpy as np


def plain(value: Any, *, limits: bool = False) -> Any:
    """Convert arrays, tuples, mappings and dataclasses to lists and dicts with JSON's types.

    With `limits`, infinite numbers stay.
    """
    convert = partial(plain, limits=limits)
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: convert(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [convert(inner) for inner in value]
    if is_dataclass(value):
        return {each.name: convert(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, float) and not math.isfinite(value):
        return value if limits and math.isinf(value) else None
    return value


def json_text(content: Any, indent: int | None = 1, *, limits: bool = False) -> str:
    """The text of a JSON document without a newline at its end; on one line without an indent.

    With `limits`, infinite numbers, as settings have, are `Infinity`, which Python reads.
    """
    return json.dumps(plain(content, limits=limits), indent=indent, allow_nan=limits)


def json_rows(content: Any, indent: str = "") -> str:
    """As `json_text`, with objects over several lines and arrays on one.

    The exception are matrices and arrays of objects: each row or object begins a line.
    """
    value, deeper = plain(content), indent + " "
    if isinstance(value, dict) and value:
        items = (f"{deeper}{json.dumps(k)}: {json_rows(v, deeper)}" for k, v in value.items())
        return "{\n" + ",\n".join(items) + f"\n{indent}}}"
    if isinstance(value, list) and value and isinstance(value[0], list | dict):
        return "[\n" + ",\n".join(deeper + json_rows(v, deeper) for v in value) + f"\n{indent}]"
    if isinstance(value, list):
        return f"[{', '.join(map(json_rows, value))}]"
    return json_text(value)
