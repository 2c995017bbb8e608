"""``python -m tools.slam_evaluation STUDY ...``: each study has its own flags (``--help``)."""

from __future__ import annotations

import sys
from importlib import import_module

from redetect.storage.command_line import exit_code_of

#: The module whose `main` carries a study out.
STUDIES = {
    "map": "tools.slam_evaluation.map_study",
    "map-speed": "tools.slam_evaluation.map_speed",
    "map-calibration": "tools.slam_evaluation.map_calibration",
    "map-modelling": "tools.slam_evaluation.map_modelling",
    "map-redetected": "tools.slam_evaluation.map_redetected",
    "association": "tools.slam_evaluation.association",
    "consistency": "tools.slam_evaluation.consistency",
}


def main(arguments: list[str]) -> int:
    """Run a study; returns the exit code."""
    if not arguments or arguments[0] not in STUDIES:
        print(
            f"usage: python -m tools.slam_evaluation {{{','.join(STUDIES)}}} ...", file=sys.stderr
        )
        return 2
    study = import_module(STUDIES[arguments[0]])
    return exit_code_of(lambda: int(study.main(arguments[1:]) or 0))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
