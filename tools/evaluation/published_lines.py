"""The line rows that the data set's report prints, beside those of `--preset published`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from camera import Camera, read_camera
from detect.line_settings import PUBLISHED, LineSettings
from detect.lines import LineDetections, detect_lines
from detect.sources.gray import decode_gray
from lut.verticals import build_vertical_table
from redetect.landmarks import LineLandmark, parse_record


@dataclass(frozen=True)
class PrintedLine:
    """A printed row and the detected one whose bearing is nearest.

    Attributes
    ----------
    step : str
        Image, such as `e.0000`.
    printed, detected : LineLandmark
        The two rows.
    printed_rows, detected_rows : tuple of float
        Image rows of their ends, top and bottom.
    members : int
        Tracks that the detected row joins.
    """

    step: str
    printed: LineLandmark
    detected: LineLandmark
    printed_rows: tuple[float, float]
    detected_rows: tuple[float, float]
    members: int

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
    """Detect the lines of the images whose rows are printed, and put them side by side.

    Parameters
    ----------
    published : Path
        `published.json`: the printed rows.
    run : Path
        Folder of run e with its images.
    settings : LineSettings
        Parameters of the detector.

    Returns
    -------
    lines : list of PrintedLine
        In the order of the report.
    detected : dict of str to int
        Rows detected in each image.
    """
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


def print_printed_lines(published: Path, run: Path, settings: LineSettings) -> None:
    """Print the table of `compare_printed_lines`."""
    lines, detected = compare_printed_lines(published, run, settings)
    print(
        "image   IDs       rows printed      rows here      ends off   alpha printed      here"
        "   off sigma   sigma printed     here  tracks"
    )
    for line in lines:
        ids = ",".join(map(str, line.printed.ids))
        print(
            f"{line.step}  {ids:9} {line.printed_rows[0]:6.2f} {line.printed_rows[1]:7.2f}"
            f"  {line.detected_rows[0]:6.2f} {line.detected_rows[1]:7.2f}"
            f"  {line.ends_off_rows:4.1f} {line.ends_off:.4f}"
            f"   {line.printed.alpha:+9.6f} {line.detected.alpha:+9.6f}"
            f"   {line.bearing_off_sigmas:9.2f}"
            f"   {line.printed.sigma:.5f}      {line.detected.sigma:.5f}  {line.members}"
            f"{'' if line.found else '  not the same'}"
        )
    print(f"{sum(line.found for line in lines)} of {len(lines)} rows")
    for step, rows in detected.items():
        printed = sum(line.step == step for line in lines)
        print(f"{step}: {printed} rows printed, {rows} detected")
