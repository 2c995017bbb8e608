"""How well rows are associated, by method and by added noise, and where a robot wakes up."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np
from tyro.conf import Positional

from redetect.landmarks import wrap_angle
from redetect.landmarks.map_file import read_map, read_path
from redetect.slam.association.registration import localise_globally
from redetect.slam.association.run import associate_run
from redetect.slam.association.scoring import score_run
from redetect.slam.errors import SlamError
from redetect.slam.mapping.run_map import map_run
from redetect.slam.noise import with_relative_noise
from redetect.slam.recording import camera_xy_of, first_poses, joined, read_recording
from redetect.slam.settings import AssociateSettings
from tools.evaluation.figures import Figures, Study, demand_some, print_figures
from tools.evaluation.tables import Table


@dataclass(frozen=True)
class Association(Study):
    """Associate runs with each method at several levels of noise, and score the results.

    They are compared with the runs' own IDs, before and after the map level.
    """

    runs: Positional[tuple[Path, ...]]  # Run folders or landmark files with IDs.
    circles: bool = False  # Use the discs; the default if neither kind is given.
    lines: bool = False  # Use the vertical lines.
    methods: tuple[Literal["nearest", "joint"], ...] = ("nearest", "joint")  # See `slam associate`.
    noise: tuple[float, ...] = (0.0, 1.0, 2.0)
    """Added noise as a factor on the rows' own standard deviations."""
    sigma_scale: float = 1.4  # Factor on the discs' standard deviations in all gates.
    seed: int = 1  # Of the noise.

    def measure(self) -> Figures:
        demand_some(self.runs, "runs")
        table = Table(
            {"run": "<12", "noise": "g", "method": "<8", "kind": "<8", "level": "<6",
             "precision": ".4f", "recall": ".4f", "rows right": ".4f", "landmarks": "d",
             "true": "d", "wrong merges": "d", "splits": "d", "s": "6.1f"}, keys=5
        )  # fmt: skip
        for path in self.runs:
            name = path.name if path.is_dir() else f"{path.parent.name}/{path.name}"
            recording = read_recording(path, circles=self.circles or not self.lines,
                                       lines=self.lines)  # fmt: skip
            camera_xy = camera_xy_of(recording, path)
            for factor in self.noise:
                noisy = with_relative_noise(recording, factor, self.seed)
                for method in self.methods:
                    settings = AssociateSettings(method=method, sigma_scale=self.sigma_scale)
                    began = time.thread_time()
                    found = associate_run(noisy, settings, camera_xy=camera_xy)
                    seconds = time.thread_time() - began
                    scores = score_run(recording, found)
                    for kind, level in ((k, v) for k in scores for v in scores[k]):
                        s = scores[kind][level]
                        table.row(
                            name, factor, method, kind, level, s.pair_precision, s.pair_recall,
                            s.right_rows, s.found_landmarks, s.true_landmarks, s.wrong_merges,
                            s.splits, seconds,
                        )  # fmt: skip
        return table.figures


@dataclass(frozen=True)
class WakingUp(Study):
    """Locate a robot at places along a run, without identifiers, and compare with a known path."""

    run: Positional[Path]  # Run folder or `.circles` file.
    map: Path  # `map.csv`.
    path: Path  # `path.csv` of the same run in that map.
    every: int = 50  # Number of frames between the places.

    def measure(self) -> Figures:
        recording, discs = read_recording(self.run), read_map(self.map).discs.xy
        poses = read_path(self.path).poses
        off, turned, taken, squared = [], [], [], []
        starts = range(0, len(recording), self.every)
        for start in starts:
            located = localise_globally(recording.part(start), discs)
            if located is None:
                continue
            difference = located.pose - poses[start]
            difference[2] = wrap_angle(difference[2])
            off.append(np.hypot(difference[0], difference[1]))
            turned.append(abs(np.degrees(difference[2])))
            taken.append(located.frames)
            squared.append(difference @ np.linalg.solve(located.covariance, difference) / 3.0)
        demand_some(off, f"{self.run}: places that were recognised, of {len(starts)}")
        table = Table({"": "<6", "off m": ".2f", "turned deg": ".1f", "after frames": ".0f"})
        for name, of in (("median", np.median), ("most", np.max)):
            table.row(name, *(of(values) for values in (off, turned, taken)))
        known = {"known": len(off), "times": len(starts), "normalised": np.mean(squared)}
        print_figures(known)
        return {**known, **table.figures}


@dataclass(frozen=True)
class Joining(Study):
    """Split a run, join the parts without their identifiers, and compare with the whole.

    Each part has its own frame. The whole is associated and mapped in the same way.
    """

    run: Positional[Path]  # Run folder or `.circles` file with IDs.
    at: tuple[int, ...] = ()  # First frames of the further parts; by default the middle.

    def measure(self) -> Figures:
        whole = read_recording(self.run)
        starts = [0, *(self.at or (len(whole) // 2,))]
        parts = [whole.part(a, b) for a, b in zip(starts, [*starts[1:], len(whole)])]
        recording = joined(parts)
        began = time.thread_time()
        found = associate_run(recording)
        seconds = time.thread_time() - began
        score = score_run(recording, found)["circles"]["map"]
        apart, one = (
            map_run(replace(run, circles=replace(run.circles, ids=labels)))
            for run, labels in (
                (recording, found.circle_labels),
                (whole, associate_run(whole).circle_labels),
            )
        )
        figures = {
            **vars(score), "factor": apart.table.factor, "factor of the whole": one.table.factor,
            "seconds": seconds,
        }  # fmt: skip
        print_figures(figures)
        table = Table({"run": "d", "frames": "d", "median m": ".3f", "median deg": ".2f",
                       "most m": ".3f", "most deg": ".2f"})  # fmt: skip
        for k, (first, start) in enumerate(zip(first_poses(parts), starts)):
            poses = apart.estimate.poses[first : first + len(parts[k]) + 1]
            off = poses - one.estimate.poses[start : start + len(poses)]
            distance, turn = np.hypot(*off[:, :2].T), np.degrees(np.abs(wrap_angle(off[:, 2])))
            table.row(k + 1, len(parts[k]), np.median(distance), np.median(turn), distance.max(),
                      turn.max())  # fmt: skip
        return {**figures, "path off the whole's": table.figures}


@dataclass(frozen=True)
class JoiningPairs(Study):
    """Split a run into pieces, join all pairs, and compare with the discs they have in common."""

    run: Positional[Path]  # Run folder or `.circles` file with IDs.
    frames: int = 300  # Frames per piece.
    least: int = 5  # Least number of common discs of pieces that show the same place.

    def measure(self) -> Figures:
        whole = read_recording(self.run)
        starts = range(0, len(whole) - self.frames + 1, self.frames)
        pieces = [whole.part(start, start + self.frames) for start in starts]
        joined_pairs, wrong, off, counts = Counter[bool](), 0, [], Counter[bool]()
        for one, other in combinations(pieces, 2):
            shared = np.intersect1d(one.circles.ids, other.circles.ids)
            same = len(shared[shared >= 0]) >= self.least
            counts[same] += 1
            try:
                both = joined([one, other])
                found = associate_run(both)
            except SlamError:
                continue
            joined_pairs[same] += 1
            score = score_run(both, found)["circles"]["map"]
            off.append(score.pair_precision)
            wrong += score.wrong_merges
        demand_some(off, f"{self.run}: pairs of {self.frames} frames that can be joined")
        table = Table({"discs in common": "<", "pairs": "d", "joined": "d"})
        table.row(f"{self.least} or more", counts[True], joined_pairs[True])
        table.row("fewer", counts[False], joined_pairs[False])
        figures = {"precision": np.mean(off), "least precision": min(off), "wrong merges": wrong}
        print_figures(figures)
        return {**table.figures, **figures}
