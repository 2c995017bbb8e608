"""Flags that several commands of ``detect`` share. `--help` needs them: nothing heavy is here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Optional

from tyro.conf import Positional, arg

# For `X | None` tyro imports another library that takes a tenth of a second.
MaybePath = Optional[Path]  # noqa: UP045
MaybeInt = Optional[int]  # noqa: UP045
MaybeFloat = Optional[float]  # noqa: UP045
MaybeStr = Optional[str]  # noqa: UP045

Preset = Literal["default", "published"]
DiscPreset = Literal["default", "published", "report"]
LineEnds = Literal["lf", "crlf"]


@dataclass(frozen=True, kw_only=True)
class RunFlags:
    """Options of all commands that process the frames of a run.

    Parameters
    ----------
    run : Path
        Run folder, folder or pattern of images, video or bag, as for `detect circles`.
    output : Path
        The file to write.
    camera : Path
        Calibration, if it is not the one in the run folder.
    force : bool
        Replace existing files.
    """

    run: Positional[Path]
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    camera: MaybePath = None
    force: bool = False


@dataclass(frozen=True, kw_only=True)
class PickedFrames:
    """Selects the frames of a run.

    Parameters
    ----------
    every : int
        Only every n-th frame.
    frames : tuple of str
        Only these frames: names of images, positions in the run, and ranges FROM:TO or
        FROM:TO:STEP of positions without the last.
    """

    every: int = 1
    frames: tuple[str, ...] = ()
