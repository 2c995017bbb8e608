"""``slam noise``: a run's landmark file with noise added."""

from __future__ import annotations

import sys

from redetect.landmarks import read_rows, write_rows
from redetect.slam.noise import AddedNoise, noisy_rows
from redetect.slam.options import Noise
from redetect.slam.recording import demand_landmarks, landmark_file


def perform(options: Noise) -> int:
    """Carry the command out; returns the exit code."""
    noise = AddedNoise(
        disc_m=options.sigma,
        bearing_rad=options.bearing_sigma,
        step_m=options.step_sigma,
        turn_rad=options.turn_sigma,
        seed=options.seed,
    )
    source = options.run
    if source.is_dir():
        source = landmark_file(source, ".lines" if options.lines else ".circles", options.stem)
    else:
        demand_landmarks(source)
    target = options.output or source.with_name(f"noisy{source.suffix}")
    write_rows(target, noisy_rows(read_rows(source), noise), overwrite=options.force)
    print(f"{target}: {noise.comment if not noise.nothing else 'no noise added'}", file=sys.stderr)
    return 0
