"""The programs of the project, by name, each with the module of its command line."""

PROGRAMS = {
    "camera": "camera.cli",
    "detect": "detect.cli",
    "groundtruth": "redetect.groundtruth.cli",
    "slam": "redetect.slam.cli",
}
