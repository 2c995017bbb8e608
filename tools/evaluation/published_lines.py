"""The line rows that the data set's report prints, beside those of `--preset published`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from tyro.conf import Positional

from camera import Camera, read_camera
from detect.line_settings import PRESETS, PUBLISHED, LineSettings
from detect.lines import LineDetections, detect_lines
from detect.sources.interface import decode_gray
from lut.verticals import build_vertical_table
from redetect.landmarks import LineLandmark, parse_record
from tools.evaluation.tables import Table


@dataclass(frozen=True)
class PrintedLine:
    """A printed row and the detected one whose bearing is nearest."""

    step: str  # Image, such as `e.0000`.
    printed: LineLandmark  # The two rows.
    detected: LineLandmark
    printed_rows: tuple[float, float]  # Image rows of their ends, top and bottom.
    detected_rows: tuple[float, float]
    members: int  # Tracks that the detected row joins.

    @property
    def ends_off_rows(self) -> float:
        """Larger distance of the ends, image rows.

        Ends of printed rows are whole image rows, halves where two lines are joined, moved a little
        by the projection of the last point to the line.
        """
        pairs = zip(self.printed_rows, self.detected_rows, strict=True)
        return max(0.5 * abs(round(2.0 * a) - round(2.0 * b)) for a, b in pairs)

    @property
    def ends_off(self) -> float:
        """Largest distance of the ends to the side, normalised coordinates."""
        return max(
            abs(self.printed.xtop - self.detected.xtop),
            abs(self.printed.xbottom - self.detected.xbottom),
        )

    @property
    def bearing_off_sigmas(self) -> float:
        """Distance of the bearings in printed standard deviations."""
        return abs(self.printed.alpha - self.detected.alpha) / self.printed.sigma

    @property
    def found(self) -> bool:
        """Whether ends, bearing, and being joined or not are those of the printed row."""
        # No single printed line has more than 0.003.
        joined = self.printed.sigma > 0.005
        return (
            self.ends_off_rows <= 1.0
            and self.ends_off <= 0.01
            and self.bearing_off_sigmas <= 1.0
            and joined == (self.members > 1)
        )


def compare_printed_lines(
    published: Path, run: Path, settings: LineSettings = PUBLISHED
) -> tuple[list[PrintedLine], dict[str, int]]:
    """Detect the lines of the images whose rows are printed, and put them side by side."""
    camera = read_camera(run / "e.cam")
    table = build_vertical_table(camera)
    found: dict[str, LineDetections] = {}
    lines = []
    for entry in json.loads(published.read_text())["lines"]:
        step = entry["step"]
        if step not in found:
            path = run / "images" / f"dlr-spatial_cognition-{step}.jpg"
            image = decode_gray(path.read_bytes(), path)
            found[step] = detect_lines(image, table, settings)
        printed = parse_record(entry["row"])
        assert isinstance(printed, LineLandmark)
        rows = found[step].landmarks()
        nearest = int(np.argmin([abs(row.alpha - printed.alpha) for row in rows]))
        lines.append(
            PrintedLine(
                step, printed, rows[nearest], _rows_of(printed, camera),
                _rows_of(rows[nearest], camera), len(found[step].members[nearest]),
            )
        )  # fmt: skip
    return lines, {step: len(detections) for step, detections in found.items()}


def _rows_of(line: LineLandmark, camera: Camera) -> tuple[float, float]:
    ends = [[line.xtop, line.ytop], [line.xbottom, line.ybottom]]
    top, bottom = camera.distort(ends)[:, 1].tolist()
    return top, bottom


@dataclass(frozen=True)
class PublishedLines:
    """Compare detected lines with the rows that the data set's report prints."""

    data: Positional[Path] = Path("../shared/data")
    """Folder with `published.json` and, in `dlr/e`, the first images of run e."""
    preset: Literal["default", "published", "report"] = "published"  # Of the line detector.

    def __call__(self) -> int:
        lines, detected = compare_printed_lines(
            self.data / "published.json", self.data / "dlr/e", PRESETS[self.preset]
        )
        print("printed and detected rows, bearings alpha and their standard deviations")
        pairs = {"rows": "7.2f", "to": "7.2f", "rows here": "7.2f", "to here": "7.2f"}
        table = Table(
            {"image": "<6", "IDs": "<9", **pairs, "ends off": ".1f", "aside": ".4f",
             "alpha": "+9.6f", "here": "+9.6f", "off / sigma": ".2f", "sigma": ".5f",
             "sigma here": ".5f", "tracks": "d", "": "<"}
        )  # fmt: skip
        for line in lines:
            table.row(
                line.step, ",".join(map(str, line.printed.ids)), *line.printed_rows,
                *line.detected_rows, line.ends_off_rows, line.ends_off, line.printed.alpha,
                line.detected.alpha, line.bearing_off_sigmas, line.printed.sigma,
                line.detected.sigma, line.members, "" if line.found else "not the same",
            )  # fmt: skip
        print(f"{sum(line.found for line in lines)} of {len(lines)} rows")
        for step, rows in detected.items():
            printed = sum(line.step == step for line in lines)
            print(f"{step}: {printed} rows printed, {rows} detected")
        return 0
