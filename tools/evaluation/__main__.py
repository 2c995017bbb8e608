"""All studies: ``python -m tools.evaluation NAME ...``; each has its own flags (``--help``)."""

from __future__ import annotations

import sys
from importlib import import_module

from tools.evaluation.figures import study_main

#: Module and class of each study.
STUDIES = {
    "accuracy": "accuracy.AccuracyStudy",
    "association": "association.Association",
    "buildings": "detection.Buildings",
    "cameras": "cameras.Cameras",
    "camera-photographs": "calibration.CameraPhotographs",
    "camera-rendered": "calibration.CameraRendered",
    "disturbed": "disturbed.Disturbed",
    "documents": "figures.Documents",
    "fusion": "sessions.FusionStudy",
    "joining": "association.Joining",
    "joining-pairs": "association.JoiningPairs",
    "laser-sessions": "sessions.LaserSessions",
    "map": "maps.MapStudy",
    "map-speed": "maps.MapSpeed",
    "markers": "markers.Markers",
    "photographs": "detection.Photographs",
    "pictures": "pictures.Pictures",
    "programs": "figures.Programs",
    "real-run": "real_run.RealRun",
    "rendered": "detection.Rendered",
    "tilt": "detection.Tilt",
    "tilt-of-discs": "tilt_of_discs.TiltOfDiscs",
    "train-rim-network": "rim_network_training.TrainRimNetwork",
    "tutorial-photographs": "boards.TutorialPhotographs",
    "waking-up": "association.WakingUp",
}


def main(arguments: list[str] | None = None) -> int:
    """Run a study; returns the exit code."""
    name, *flags = (sys.argv[1:] if arguments is None else arguments) or [""]
    if name not in STUDIES:
        asked = name in ("-h", "--help")
        usage = f"usage: python -m tools.evaluation NAME ...; NAME is one of {', '.join(STUDIES)}"
        print(usage, file=sys.stdout if asked else sys.stderr)
        return 0 if asked else 2
    module, _, study = STUDIES[name].partition(".")
    options = getattr(import_module(f"tools.evaluation.{module}"), study)
    return study_main(options, f"python -m tools.evaluation {name}", flags)


if __name__ == "__main__":
    sys.exit(main())
