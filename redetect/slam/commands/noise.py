"""``slam noise``: a run's measurements with noise added."""

from __future__ import annotations

from redetect.landmarks import read_rows, write_rows
from redetect.slam.noise import noisy_rows
from redetect.slam.options import Noise
from redetect.slam.recording import landmark_files


def perform(options: Noise) -> int:
    """Execute the command; returns the exit code."""
    noise, lines = options.noise, options.lines
    (source,) = landmark_files(options.run, circles=not lines, lines=lines, stem=options.stem)
    target = options.output or source.with_name(f"noisy{source.suffix}")
    write_rows(target, noisy_rows(read_rows(source), noise), overwrite=options.force)
    print(f"{target}: {noise.comment if not noise.nothing else 'no noise added'}")
    return 0
