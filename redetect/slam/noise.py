"""White Gaussian noise on a run's rows, with their covariances raised to match."""

from __future__ import annotations

import math
from codecs import BOM_UTF8
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from redetect import landmarks
from redetect.landmarks.records import numbers_of_step
from redetect.slam.recording import ASSUMED, Recording
from redetect.slam.settings import AddedNoise


def noisy_rows(rows: Iterable[landmarks.Row], noise: AddedNoise) -> Iterator[landmarks.Row]:
    """Rows of a landmark file with noise added; without noise they are unchanged.

    Covariances become the sum of both, with the assumed one for a step that states none; a comment
    at the head states what was added.
    """
    of_steps = np.random.default_rng([noise.seed, 0])
    of_landmarks = np.random.default_rng([noise.seed, 1])
    for number, row in enumerate(rows):
        if number == 0 and not noise.nothing:
            line_end = b"\r\n" if (row.source or b"").endswith(b"\r\n") else b"\n"
            yield landmarks.Row(None, b"# " + noise.comment.encode() + line_end)
            if row.source is not None:  # the mark would be in the second line
                row = replace(row, source=row.source.removeprefix(BOM_UTF8))
        record = row.record
        rng = of_steps if isinstance(record, landmarks.Step) else of_landmarks
        yield row if record is None else row.with_record(_noisy(record, noise, rng))


def _noisy(
    record: landmarks.Record, noise: AddedNoise, rng: np.random.Generator
) -> landmarks.Record:
    """A row with noise; unchanged if its kind gets none."""
    if isinstance(record, landmarks.Step) and (noise.step_sigma or noise.turn_sigma):
        cxx, cyy, cphiphi = record.cxx, record.cyy, record.cphiphi
        if not any(numbers_of_step(record)[3:]):
            movement = np.array([[record.dx, record.dy, record.dphi]])
            cxx, cyy, cphiphi = np.diag(ASSUMED.covariance(movement)[0]).tolist()
        x, y, turn = rng.standard_normal(3).tolist()
        return replace(
            record,
            dx=record.dx + noise.step_sigma * x,
            dy=record.dy + noise.step_sigma * y,
            dphi=record.dphi + noise.turn_sigma * turn,
            cxx=cxx + noise.step_sigma**2,
            cyy=cyy + noise.step_sigma**2,
            cphiphi=cphiphi + noise.turn_sigma**2,
        )
    if isinstance(record, landmarks.CircleLandmark) and noise.sigma:
        x, y = rng.standard_normal(2).tolist()
        return replace(
            record,
            px=record.px + noise.sigma * x,
            py=record.py + noise.sigma * y,
            cxx=record.cxx + noise.sigma**2,
            cyy=record.cyy + noise.sigma**2,
        )
    if isinstance(record, landmarks.LineLandmark) and noise.bearing_sigma:
        alpha = record.alpha + noise.bearing_sigma * float(rng.standard_normal())
        sigma = math.hypot(record.sigma, noise.bearing_sigma)
        return replace(record, alpha=float(landmarks.wrap_angle(alpha)), sigma=sigma)
    return record


def with_relative_noise(recording: Recording, factor: float, seed: int) -> Recording:
    """A run with noise on its landmark rows, a factor times their own standard deviations.

    Covariances are multiplied by 1 + factor^2; odometry stays. Noise is determined by the seed.
    """
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
            bearing_rad=landmarks.wrap_angle(lines.bearing_rad + factor * turned),
            sigma_rad=lines.sigma_rad * math.sqrt(1.0 + factor**2),
        ),
    )
