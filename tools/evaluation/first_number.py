"""The first number that a stranger sees: detection without a flag, held against the truth.

Everything goes through the command line, as a user would do it.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from redetect.landmarks import read_frames, squared_mahalanobis
from redetect.storage import write_whole
from tools.evaluation.real_run import compare_rows, run_program
from tools.evaluation.tables import markdown_table
from tools.fuzz.bag_readers import Ros

#: The table's place in a document, by comments.
BEGIN, END = "<!-- first numbers -->", "<!-- end of first numbers -->"
_FRAMES_PER_SECOND = 2.0
_BOARD = ("--columns", "9", "--rows", "6")


@dataclass(frozen=True)
class FirstNumbers:
    """No flags, on the demo, a drive of one's own, a bag, renders and photographs."""

    demo: Path = Path("images/e")  # The demo run.
    data: Path = Path("../shared/data")  # Evaluation data.
    document: Path | None = None  # Document whose table is written anew.

    def __call__(self) -> int:
        with tempfile.TemporaryDirectory() as folder:
            table = table_of(list(first_numbers(self.demo, self.data, Path(folder))))
        print(table)
        if self.document is not None:
            put_into(self.document, table)
        return 0


@dataclass(frozen=True)
class FirstNumber:
    """A line of the table: errors of the rows that were matched to true discs."""

    what: str
    commands: str
    found: int
    reference: int
    median_m: float
    normalised: float


def first_numbers(demo: Path, data: Path, folder: Path) -> Iterator[FirstNumber]:
    """Detect the demo, a drive with a calibration of one's own, a bag, renders and photographs.

    What is absent of `data` is left out; files in between go to `folder`.
    """
    reference = demo / "map.circles"
    for command in ("circles", "all"):
        rows = _detected(command, folder / f"demo-{command}", demo)
        yield _compared("demo", f"`detect {command}`", demo, rows, reference)

    mine = folder / "mine"
    run_program("tools.evaluation", "tutorial-photographs", mine)
    boards = ("--half", *_BOARD, "--square-m", "0.04")
    run_program("camera", "calibrate", mine / "boards", *boards, "-o", mine / "lens.cam")
    board = (*_BOARD, "--square-m", "0.12", "--floor-origin", "0", "-1.3", "--floor-yaw", "180")
    run_program(
        "camera", "floor", mine / "lens.cam", mine / "floor.png", *board, "-o", mine / "my.cam"
    )
    drive = mine / "drive"
    shutil.copytree(demo / "images", drive)
    shutil.copy(mine / "my.cam", drive)
    rows = _detected("all", folder / "mine-all", drive, "--odometry", next(demo.glob("*.txt")))
    commands = "`camera calibrate`, `floor`, `detect all`"
    yield _compared("own drive, own calibration", commands, drive, rows, reference)

    bag = folder / "bag"
    bag.mkdir()
    shutil.copy(next(demo.glob("*.cam")), bag)
    recorded = write_bag(demo / "images", bag / "drive")
    rows = _detected("all", folder / "bag-all", recorded)
    _name_frames(rows, demo / "images")
    yield _compared("bag (MCAP)", "`detect all`", demo, rows, reference)

    for name in ("r1", "r2"):
        run = data / "rendered" / name
        if run.is_dir():
            rows = _detected("all", folder / name, run)
            yield _compared(
                f"rendered building {name}", "`detect all`", run, rows, run / "truth.circles"
            )
    photographs = sorted(path.parent for path in data.glob("discs/dev/*/truth.json"))
    if photographs:
        yield _photographs(photographs, folder)


def write_bag(images: Path, place: Path) -> Path:
    """An MCAP file of the images of a folder, as ROS 2 writes them."""
    ros = Ros("mcap")

    def recorded() -> Iterator[tuple[str, int, Any]]:
        for number, path in enumerate(sorted(images.iterdir())):
            nanoseconds = round(1e9 * (1.0 + number / _FRAMES_PER_SECOND))
            header, data = ros.header(nanoseconds), np.fromfile(path, np.uint8)
            name = "sensor_msgs/msg/CompressedImage"
            yield "/image", nanoseconds, ros.make(name, header=header, format="jpeg", data=data)

    ros.write(place, recorded())
    return (place / f"{place.name}.mcap").rename(place.with_suffix(".mcap"))


def _name_frames(rows: Path, images: Path) -> None:
    """Call the frames of a bag, which are named by their times, as the images are."""
    frames = list(read_frames(rows))
    names = {frame.step.prefix: p.stem for frame, p in zip(frames, sorted(images.iterdir()))}
    words = (line.split(" ") for line in rows.read_text().splitlines())
    named = [
        " ".join([line[0], names[line[1]], *line[2:]] if line[0] == "STEP" else line)
        for line in words
    ]
    rows.write_text("\n".join([*named, ""]))


def _photographs(runs: list[Path], folder: Path) -> FirstNumber:
    """Discs that were measured in photographs; truth is known to a fraction of a millimetre."""
    errors, squared, reference = [], [], 0
    for run in runs:
        rows = _detected("circles", folder / f"photograph-{run.name}", run)
        truth = json.loads((run / "truth.json").read_text())["discs"]
        places = np.array([(disc["px"], disc["py"]) for disc in truth if disc["visible"]])
        reference += len(places)
        found = [row for frame in read_frames(rows) for row in frame.circles]
        if not found or not len(places):
            continue
        distance, nearest = KDTree(places).query([(row.px, row.py) for row in found])
        for row, apart, place in zip(found, distance, places[nearest]):
            if apart < 0.05:
                covariance = [[row.cxx, row.cxy], [row.cxy, row.cyy]]
                errors.append(apart)
                squared.append(squared_mahalanobis(place - (row.px, row.py), covariance) / 2.0)
    return FirstNumber(
        f"{len(runs)} photographs of disc boards", "`detect circles`", len(errors), reference,
        float(np.median(errors)), float(np.mean(squared)),
    )  # fmt: skip


def _detected(command: str, output: Path, *arguments: object) -> Path:
    """The file of discs of a command."""
    output.mkdir()
    rows = output / "detected.circles"
    target = rows if command == "circles" else output
    run_program("detect", command, *arguments, "--output", target)
    return rows


def _compared(what: str, commands: str, run: Path, rows: Path, reference: Path) -> FirstNumber:
    result = compare_rows(run, rows, "--reference", reference)
    return FirstNumber(
        what, commands, result["matched"], result["reference"], result["error_median_m"],
        result["normalised_error"]["per_dof"],
    )  # fmt: skip


def table_of(numbers: list[FirstNumber]) -> str:
    """The table as Markdown."""
    rows = [
        (n.what, n.commands, f"{n.found} of {n.reference}", f"{1e3 * n.median_m:.1f}",
         f"{n.normalised:.2f}")
        for n in numbers
    ]  # fmt: skip
    head = ("", "commands", "found", "median error / mm", "normalised error²")
    return "\n".join(markdown_table(head, rows))


def put_into(document: Path, table: str) -> None:
    """Replace what is between `BEGIN` and `END` in a document."""
    before, _, rest = document.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise ValueError(f"{document}: lacks {BEGIN} and {END}")
    with write_whole(document, overwrite=True) as stream:
        stream.write(f"{before}{BEGIN}\n\n{table}\n\n{END}{after}".encode())
