"""White Gaussian noise on a run's rows, which say so in their covariances: ``slam noise``."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from redetect.landmarks import (
    CircleLandmark,
    LineLandmark,
    Record,
    Row,
    Step,
    read_rows,
    wrap_angle,
    write_rows,
)
from redetect.slam.errors import SlamError
from redetect.slam.options import Noise
from redetect.slam.recording import Recording, landmark_files
from redetect.storage.bounds import NotNegative, demand_fields, whole


@dataclass(frozen=True)
class AddedNoise:
    """Standard deviations of the added noise, independent for each number."""

    disc_m: NotNegative = 0.0  # to x and y of a disc
    # To the bearing of a line. Its ends in the image stay as they are.
    bearing_rad: NotNegative = 0.0
    step_m: NotNegative = 0.0  # to dx and dy of a step
    turn_rad: NotNegative = 0.0  # to dphi of a step
    # Steps and landmarks draw from streams of their own, so that the files of discs and of lines of
    # one run get the same odometry.
    seed: Annotated[int, whole(0)] = 1

    def __post_init__(self) -> None:
        demand_fields(self, SlamError)

    @property
    def nothing(self) -> bool:
        """Whether all are 0."""
        return not (self.disc_m or self.bearing_rad or self.step_m or self.turn_rad)

    @property
    def comment(self) -> str:
        """The head of the file."""
        return (
            f"Noise was added, standard deviations: discs {self.disc_m:g} m, bearings "
            f"{self.bearing_rad:g} rad, dx and dy {self.step_m:g} m, dphi {self.turn_rad:g} rad; "
            f"seed {self.seed}. The covariances are raised to match."
        )


def perform(options: Noise) -> int:
    """Carry the command out; returns the exit code."""
    noise = AddedNoise(
        disc_m=options.sigma,
        bearing_rad=options.bearing_sigma,
        step_m=options.step_sigma,
        turn_rad=options.turn_sigma,
        seed=options.seed,
    )
    (source,) = landmark_files(
        options.run, circles=not options.lines, lines=options.lines, stem=options.stem
    )
    target = options.output or source.with_name(f"noisy{source.suffix}")
    write_rows(target, noisy_rows(read_rows(source), noise), overwrite=options.force)
    print(f"{target}: {noise.comment if not noise.nothing else 'no noise added'}", file=sys.stderr)
    return 0


def noisy_rows(rows: Iterable[Row], noise: AddedNoise) -> Iterator[Row]:
    """Rows of a landmark file with noise added.

    Values are changed, covariances become the sum of both; IDs, qualities and comments stay. A
    comment at the head says what was added. Without noise the rows come out as they are.
    """
    of_steps = np.random.default_rng([noise.seed, 0])
    of_landmarks = np.random.default_rng([noise.seed, 1])
    first = True
    for row in rows:
        if first and not noise.nothing:
            line_end = b"\r\n" if (row.source or b"").endswith(b"\r\n") else b"\n"
            yield Row(None, b"# " + noise.comment.encode() + line_end)
        first = False
        record = row.record
        rng = of_steps if isinstance(record, Step) else of_landmarks
        yield row if record is None else row.with_record(_noisy(record, noise, rng))


def _noisy(record: Record, noise: AddedNoise, rng: np.random.Generator) -> Record:
    """A row with noise, as it is where its kind gets none."""
    if isinstance(record, Step) and (noise.step_m or noise.turn_rad):
        x, y, turn = rng.standard_normal(3).tolist()
        return replace(
            record,
            dx=record.dx + noise.step_m * x,
            dy=record.dy + noise.step_m * y,
            dphi=record.dphi + noise.turn_rad * turn,
            cxx=record.cxx + noise.step_m**2,
            cyy=record.cyy + noise.step_m**2,
            cphiphi=record.cphiphi + noise.turn_rad**2,
        )
    if isinstance(record, CircleLandmark) and noise.disc_m:
        x, y = rng.standard_normal(2).tolist()
        return replace(
            record,
            px=record.px + noise.disc_m * x,
            py=record.py + noise.disc_m * y,
            cxx=record.cxx + noise.disc_m**2,
            cyy=record.cyy + noise.disc_m**2,
        )
    if isinstance(record, LineLandmark) and noise.bearing_rad:
        alpha = record.alpha + noise.bearing_rad * float(rng.standard_normal())
        sigma = math.hypot(record.sigma, noise.bearing_rad)
        return replace(record, alpha=float(wrap_angle(alpha)), sigma=sigma)
    return record


def with_relative_noise(recording: Recording, factor: float, seed: int) -> Recording:
    """A run whose landmark rows are noisier by a factor on their own standard deviations.

    Covariances become 1 + factor^2 times what they were; odometry stays. Everything random follows
    from the seed.
    """
    AddedNoise(disc_m=factor, seed=seed)  # which refuses what makes no sense
    rng = np.random.default_rng([seed, 2])
    circles, lines = recording.circles, recording.lines
    root = np.linalg.cholesky(circles.covariance)
    added = np.einsum("nij,nj->ni", root, rng.standard_normal(circles.xy.shape))
    turned = lines.sigma_rad * rng.standard_normal(len(lines))
    return replace(
        recording,
        circles=replace(
            circles,
            xy=circles.xy + factor * added,
            covariance=circles.covariance * (1.0 + factor**2),
        ),
        lines=replace(
            lines,
            bearing_rad=wrap_angle(lines.bearing_rad + factor * turned),
            sigma_rad=lines.sigma_rad * math.sqrt(1.0 + factor**2),
        ),
    )
