"""Landmark records, their files, and the association of records.

>>> from redetect.landmarks import read_frames
>>> for frame in read_frames("images/e/map.circles"):          # doctest: +SKIP
...     print(frame.step.prefix, [circle.ids for circle in frame.circles])
"""

from redetect.landmarks.arrays import (
    CircleArrays,
    circle_arrays,
    circle_landmarks,
    is_positive_definite,
)
from redetect.landmarks.association import (
    Association,
    associate,
    associate_positions,
    associate_within_covariance,
    squared_mahalanobis,
    wrap_angle,
)
from redetect.landmarks.files import (
    format_frame,
    format_head,
    format_levelling,
    format_record,
    frames_of_rows,
    parse_record,
    parse_rows,
    read_frames,
    read_rows,
    read_steps,
    write_frames,
    write_rows,
)
from redetect.landmarks.records import (
    CircleLandmark,
    Frame,
    Landmark,
    LandmarkError,
    LandmarkFileError,
    LineLandmark,
    MarkerCorner,
    MarkerLandmark,
    Record,
    Row,
    Step,
)
from redetect.landmarks.tilts import (
    FrameTilt,
    format_no_tilt,
    format_outline_tilt,
    format_tilt,
    read_tilts,
    tilt_as_written,
)

__all__ = [
    "Association",
    "CircleArrays",
    "CircleLandmark",
    "Frame",
    "FrameTilt",
    "Landmark",
    "LandmarkError",
    "LandmarkFileError",
    "LineLandmark",
    "MarkerCorner",
    "MarkerLandmark",
    "Record",
    "Row",
    "Step",
    "associate",
    "associate_positions",
    "associate_within_covariance",
    "circle_arrays",
    "circle_landmarks",
    "format_frame",
    "format_head",
    "format_levelling",
    "format_no_tilt",
    "format_outline_tilt",
    "format_record",
    "format_tilt",
    "frames_of_rows",
    "is_positive_definite",
    "parse_record",
    "parse_rows",
    "read_frames",
    "read_rows",
    "read_steps",
    "read_tilts",
    "squared_mahalanobis",
    "tilt_as_written",
    "wrap_angle",
    "write_frames",
    "write_rows",
]
