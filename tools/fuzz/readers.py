"""All readers of files from unknown sources, with files that they accept, for fuzzing."""

from __future__ import annotations

from tools.fuzz.bag_readers import BAG_READERS
from tools.fuzz.camera_readers import CAMERA_READERS
from tools.fuzz.detect_readers import DETECT_READERS
from tools.fuzz.groundtruth_readers import GROUNDTRUTH_READERS
from tools.fuzz.landmark_readers import LANDMARK_READERS
from tools.fuzz.reader import Reader

READERS: tuple[Reader, ...] = (
    *CAMERA_READERS,
    *LANDMARK_READERS,
    *DETECT_READERS,
    *BAG_READERS,
    *GROUNDTRUTH_READERS,
)
