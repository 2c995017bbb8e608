"""The rows of all files as tables: named columns with units, one schema for all output formats.

Every table begins with the frame of a row. Coordinates are those of the files: robot
frame X left, Y backward, on the floor; pixels from the centre of the top left one.
"""

from __future__ import annotations

from dataclasses import astuple, fields
from typing import Literal, NamedTuple

from redetect.landmarks.frame_files import FrameTilt
from redetect.landmarks.records import (
    MARKER_CORNERS,
    CircleLandmark,
    Landmark,
    LineLandmark,
    MarkerLandmark,
    Step,
)

Kind = Literal["text", "number", "whole number", "whole numbers"]
TableName = Literal["steps", "circles", "lines", "markers", "tilts"]
Value = str | float | int | tuple[int, ...] | None
#: The table to which a record belongs, by its type.
TABLE_OF: dict[type, TableName] = {
    Step: "steps",
    CircleLandmark: "circles",
    LineLandmark: "lines",
    MarkerLandmark: "markers",
    FrameTilt: "tilts",
}


class Column(NamedTuple):
    """A column of a table; its unit is 1 for pure numbers, empty for text and identifiers."""

    name: str
    kind: Kind
    unit: str
    meaning: str


def _numbers(*columns: tuple[str, str, str]) -> tuple[Column, ...]:
    return tuple(Column(name, "number", unit, meaning) for name, unit, meaning in columns)


FRAME_COLUMNS = (
    Column("frame", "whole number", "", "number of the frame in its file, from 0"),
    Column("image", "text", "", "prefix of the frame's image"),
    Column("time_s", "number", "s", "when the image was taken, where that is known"),
)

_IDS = Column("ids", "whole numbers", "", "identifiers, -1 unknown; usually one")

_MARKER_CORNERS = _numbers(
    *(
        (f"{corner.replace(' ', '_')}_{name}", unit, meaning.format(corner))
        for corner in MARKER_CORNERS
        for name, unit, meaning in (
            ("u_px", "px", "column of the {} corner"),
            ("v_px", "px", "row of the {} corner"),
            ("cuu_px2", "px^2", "variance of the column"),
            ("cuv_px2", "px^2", "covariance of column and row"),
            ("cvv_px2", "px^2", "variance of the row"),
        )
    )
)

_OWN_COLUMNS: dict[TableName, tuple[Column, ...]] = {
    "steps": _numbers(
        ("dx_m", "m", "movement to the left, in the robot's frame before it"),
        ("dy_m", "m", "movement backward"),
        ("dphi_rad", "rad", "turn, counterclockwise from above"),
        ("cxx_m2", "m^2", "variance of dx"),
        ("cxy_m2", "m^2", "covariance of dx and dy"),
        ("cyy_m2", "m^2", "variance of dy"),
        ("cxphi_m_rad", "m rad", "covariance of dx and dphi"),
        ("cyphi_m_rad", "m rad", "covariance of dy and dphi"),
        ("cphiphi_rad2", "rad^2", "variance of dphi"),
    ),
    "circles": (
        *_numbers(
            ("px_m", "m", "the disc's centre, to the left of the robot"),
            ("py_m", "m", "the disc's centre, behind the robot (in front: negative)"),
            ("quality", "1", "the detector's confidence, 0 to 1"),
            ("cxx_m2", "m^2", "variance of px"),
            ("cxy_m2", "m^2", "covariance of px and py"),
            ("cyy_m2", "m^2", "variance of py"),
        ),
        _IDS,
    ),
    "lines": (
        *_numbers(
            ("xtop", "1", "upper end, undistorted normalised image coordinates, to the right"),
            ("ytop", "1", "upper end, downward"),
            ("xbottom", "1", "lower end, to the right"),
            ("ybottom", "1", "lower end, downward"),
            ("alpha_rad", "rad", "bearing, 0 forward, positive to the left"),
            ("beta_rad", "rad", "inclination of the plane through camera and line"),
            ("quality", "1", "the detector's confidence; always 0 in the data set's own files"),
            ("sigma_rad", "rad", "standard deviation of alpha"),
        ),
        _IDS,
    ),
    "markers": (
        Column("dictionary", "text", "", "which set of markers it is from"),
        Column("id", "whole number", "", "the marker's number in that set"),
        *_numbers(("quality", "1", "agreement of the cells with the pattern, 1 is perfect")),
        *_MARKER_CORNERS,
    ),
    "tilts": (
        *_numbers(
            ("pitch_rad", "rad", "rotation about the robot's X that turns directions level"),
            ("roll_rad", "rad", "rotation about the robot's Y"),
            ("cpp_rad2", "rad^2", "variance of pitch"),
            ("cpr_rad2", "rad^2", "covariance of pitch and roll"),
            ("crr_rad2", "rad^2", "variance of roll"),
        ),
        Column("lines", "whole number", "", "verticals that agree with it"),
    ),
}
#: The columns of each table.
TABLES = {name: (*FRAME_COLUMNS, *own) for name, own in _OWN_COLUMNS.items()}


def values_of(record: Step | Landmark | FrameTilt) -> tuple[Value, ...]:
    """The values of a record, in the order of its table's columns after `FRAME_COLUMNS`."""
    if isinstance(record, MarkerLandmark):
        corners = [value for corner in record.corners for value in astuple(corner)]
        return (record.dictionary, record.id, record.quality, *corners)
    names = [field.name for field in fields(record) if field.name != "prefix"]
    return tuple(getattr(record, name) for name in names)
