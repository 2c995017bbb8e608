"""The programs of the project, by name, each with the module of its command line.

`redetect` runs each of them as a command of its own, and some commands of `detect` directly.
"""

from __future__ import annotations

PROGRAMS = {
    "camera": "camera.cli",
    "detect": "detect.cli",
    "groundtruth": "redetect.groundtruth.cli",
    "slam": "redetect.slam.cli",
}
#: Commands of `detect` that are commands of `redetect`, too.
DIRECT = ("compare", "draw", "view", "report", "tune", "export", "explain", "demo")
