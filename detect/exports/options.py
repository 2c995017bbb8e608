"""The flags of ``detect export``. Nothing heavy is imported: `--help` needs them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from detect.flags import MaybeFloat, MaybePath

Format = Literal["csv", "parquet", "mcap"]


@dataclass(frozen=True)
class Export:
    """Write the rows of a file in another format, with named columns and units.

    Example: detect export images/e/map.circles --to csv -o /tmp/discs.csv, or:
    detect export drive.detected.circles --to mcap

    Cameras of COLMAP come from the calibration: camera convert e.cam cameras.txt

    Parameters
    ----------
    file : Path
        A .circles, .lines, .markers or .tilt file, or one of STEP rows.
    to : str
        csv, with a line of names and units; parquet (extra [parquet]); or mcap, messages of ROS 2
        (extra [bags]).
    output : Path
        The file to write; by default the file's name and the format's. The steps go beside it, as
        .steps.csv or .steps.parquet; MCAP has all in one.
    times : Path
        Times of the frames, rows `prefix seconds`; by default <file>.times, or that of what was
        detected together (detected.times).
    rate_hz : float
        Frame rate to use without times, the first frame at 0 s. MCAP needs one or the other.
    force : bool
        Replace existing files.
    """

    file: Positional[Path]
    to: Format = "csv"
    output: Annotated[MaybePath, arg(aliases=["-o"])] = None
    times: MaybePath = None
    rate_hz: MaybeFloat = None
    force: bool = False
