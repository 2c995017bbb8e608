"""Landmark records, their files, and the association of records.

>>> from redetect.landmarks import read_frames
>>> for frame in read_frames("images/e/map.circles"):          # doctest: +SKIP
...     print(frame.step.prefix, [circle.ids for circle in frame.circles])
"""

from redetect.landmarks.arrays import Association as Association
from redetect.landmarks.arrays import CircleArrays as CircleArrays
from redetect.landmarks.arrays import associate as associate
from redetect.landmarks.arrays import associate_positions as associate_positions
from redetect.landmarks.arrays import circle_arrays as circle_arrays
from redetect.landmarks.arrays import circle_landmarks as circle_landmarks
from redetect.landmarks.arrays import is_positive_definite as is_positive_definite
from redetect.landmarks.arrays import squared_mahalanobis as squared_mahalanobis
from redetect.landmarks.arrays import wrap_angle as wrap_angle
from redetect.landmarks.files import format_frame as format_frame
from redetect.landmarks.files import format_head as format_head
from redetect.landmarks.files import format_levelling as format_levelling
from redetect.landmarks.files import format_record as format_record
from redetect.landmarks.files import frames_of_rows as frames_of_rows
from redetect.landmarks.files import parse_rows as parse_rows
from redetect.landmarks.files import read_frames as read_frames
from redetect.landmarks.files import read_rows as read_rows
from redetect.landmarks.files import read_steps as read_steps
from redetect.landmarks.files import write_frames as write_frames
from redetect.landmarks.files import write_rows as write_rows
from redetect.landmarks.frame_files import FrameTilt as FrameTilt
from redetect.landmarks.frame_files import format_no_tilt as format_no_tilt
from redetect.landmarks.frame_files import format_outline_tilt as format_outline_tilt
from redetect.landmarks.frame_files import format_tilt as format_tilt
from redetect.landmarks.frame_files import read_tilts as read_tilts
from redetect.landmarks.frame_files import tilt_as_written as tilt_as_written
from redetect.landmarks.records import CircleLandmark as CircleLandmark
from redetect.landmarks.records import Frame as Frame
from redetect.landmarks.records import Landmark as Landmark
from redetect.landmarks.records import LandmarkError as LandmarkError
from redetect.landmarks.records import LandmarkFileError as LandmarkFileError
from redetect.landmarks.records import LineLandmark as LineLandmark
from redetect.landmarks.records import MarkerCorner as MarkerCorner
from redetect.landmarks.records import MarkerLandmark as MarkerLandmark
from redetect.landmarks.records import Record as Record
from redetect.landmarks.records import Row as Row
from redetect.landmarks.records import Step as Step
