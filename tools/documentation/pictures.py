"""Draw the pictures of the documentation anew.

    python -m tools.documentation.pictures --tutorial T --rows R --session S

T is the folder in which the tutorial's commands were run. R and S come from

    python -m tools.simulator rows R --frames 900 --seed 1
    slam associate R -o R/found.circles
    slam map R --stem found -o R/slam
    slam ekf R -o R/ekf
    python -m tools.simulator laser-session S --visits 2 --visit-s 15 --references 3 --rate-hz 25 \
        --onboard-hz 25 --seed 1
    groundtruth lasers S
    groundtruth laser S
    groundtruth sync S/odometry.csv S/laser.csv -o S/clock.json
    groundtruth fuse S/odometry.csv --laser S/laser.csv --camera S/camera.csv --clock S/clock.json \
        -o S/fused.csv
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Optional

import numpy as np
import tyro

from tools.documentation.detection import draw_discs, draw_markers, draw_tables, draw_verticals
from tools.documentation.frames import draw_frames
from tools.documentation.paths import draw_association, draw_clock, draw_filter, draw_laser

# For `X | None` tyro imports another library that takes a tenth of a second.
MaybePath = Optional[Path]  # noqa: UP045


@dataclass(frozen=True)
class Pictures:
    """Draw the pictures of the documentation anew.

    Parameters
    ----------
    output : Path
        Folder for the pictures.
    tutorial : Path
        Where the tutorial's commands were run (it has `mine`).
    rows : Path
        A simulated run, associated and mapped.
    session : Path
        A simulated session, worked out.
    """

    output: Path = Path("docs/images")
    tutorial: MaybePath = None
    rows: MaybePath = None
    session: MaybePath = None


def draw_pictures(options: Pictures) -> None:
    """Draw what there is input for."""
    folder = options.output
    folder.mkdir(parents=True, exist_ok=True)
    run = Path("images/e")
    _save(folder / "frames.png", (9.5, 15.5), draw_frames, 75)
    _save(folder / "discs.png", (8, 9.4), lambda f: draw_discs(f, run, 4), 72)
    _save(folder / "verticals.png", (8, 9.4), lambda f: draw_verticals(f, run, 15), 72)
    _save(folder / "tables.png", (8, 6.4), lambda f: draw_tables(f, run), 72)
    _save(
        folder / "marker-phases.png", (13, 4), lambda f: draw_markers(f, Path("images/m/a"), 6), 80
    )
    if (mine := options.tutorial) is not None:
        mine = mine / "mine"
        _save(folder / "tutorial-photographs.png", (12, 1.9), lambda f: _photographs(f, mine), 75)
        shutil.copyfile(mine / "map" / "map.png", folder / "tutorial-map.png")
    if (rows := options.rows) is not None:
        _save(folder / "association.png", (12, 5.5), lambda f: draw_association(f, rows), 80)
        _save(folder / "ekf-errors.png", (13, 3.6), lambda f: draw_filter(f, rows), 80)
    if (session := options.session) is not None:
        _save(folder / "laser.png", (11, 4.6), lambda f: draw_laser(f, session, 8.0), 80)
        _save(folder / "clocks-and-fusion.png", (13, 4), lambda f: draw_clock(f, session), 80)


def _photographs(figure: Any, folder: Path) -> None:
    import cv2

    files = [*sorted((folder / "boards").glob("*.png"))[1:3], folder / "floor.png"]
    for axes, file in zip(figure.subplots(1, 3), files, strict=True):
        axes.imshow(np.asarray(cv2.imread(str(file), 0)), cmap="gray", vmin=0, vmax=255)
        axes.axis("off")


def _save(
    file: Path, size_inches: tuple[float, float], draw: Callable[[Any], None], dpi: int
) -> None:
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(mpl.rcParamsDefault):
        figure = Figure(figsize=size_inches, layout="constrained")
        FigureCanvasAgg(figure)
        draw(figure)
        figure.savefig(file, dpi=dpi, metadata={"Software": None})


if __name__ == "__main__":
    draw_pictures(tyro.cli(Pictures, description=Pictures.__doc__))
