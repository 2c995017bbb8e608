"""The parts of a report."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field

import numpy as np

from detect.comparison.report import number

_INCHES_PX = 96.0


@dataclass(frozen=True)
class Part:
    """A piece of a section: what the template makes of it is its `kind`."""

    kind: str
    words: str = ""
    address: str = ""
    width: int = 0
    height: int = 0
    caption: str = ""
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    text: tuple[int, ...] = ()
    entries: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Section:
    """A section with its heading."""

    key: str
    name: str
    parts: list[Part] = field(default_factory=list)


def figure_part(svg: bytes, words: str) -> Part:
    """A figure with its caption; its size is what it was drawn in."""
    start = svg[:2000].decode()
    width, height = (
        float(start.split(f' {name}="')[1].split('pt"')[0]) / 72.0 * _INCHES_PX
        for name in ("width", "height")
    )
    return Part("figure", words, data_address(svg, "svg+xml"), round(width), round(height))


def data_address(content: bytes, kind: str) -> str:
    """An image as an address that holds it; `kind` is its type behind ``image/``."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def range_text(from_m: float | None, to_m: float | None) -> str:
    """A range of distances, open at an end that is None."""
    if from_m is None:
        return f"below {to_m:g}"
    return f"{from_m:g} and more" if to_m is None else f"{from_m:g} to {to_m:g}"


def scaled(value: float | None, factor: float, decimals: int) -> str:
    """A figure in another unit, or a dash where there is none."""
    return number(None if value is None else factor * value, decimals)


def share_text(value: float) -> str:
    """A share, or a dash where it is NaN."""
    return f"{value:.3f}" if np.isfinite(value) else "-"
