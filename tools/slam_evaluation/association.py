"""How well rows are associated, by method and by added noise.

``python -m tools.slam_evaluation.association RUN ...`` associates each run with each method at each
level of noise, scores the result against the run's own IDs before and after the map level, and
prints a table.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Optional

import tyro
from tyro.conf import Positional, arg

from redetect.slam.association.frame_to_frame import LocalSettings
from redetect.slam.association.run import AssociateSettings, associate_run
from redetect.slam.commands.associate import score_run
from redetect.slam.commands.filter_input import camera_xy_of
from redetect.slam.noise import with_relative_noise
from redetect.slam.recording import read_recording
from redetect.storage import write_whole

COLUMNS = (
    *("run", "noise", "method", "kind", "level", "precision", "recall", "rows right"),
    *("landmarks", "wrong merges", "splits", "s"),
)


@dataclass(frozen=True)
class Study:
    """Associate runs at several levels of noise, and score the results.

    Parameters
    ----------
    runs : several paths
        Run folders or landmark files with IDs.
    circles : bool
        Use the discs; so it is, too, where neither kind is asked for.
    lines : bool
        Use the vertical lines.
    methods : several of nearest, joint
        See `slam associate`.
    noise : several floats
        Added noise as a factor on the rows' own standard deviations.
    sigma_scale : float
        Factor on the discs' standard deviations in all gates.
    seed : int
        Of the noise.
    output : Path
        Write all numbers there as JSON.
    force : bool
        Replace an existing file.
    """

    runs: Positional[tuple[Path, ...]]
    circles: bool = False
    lines: bool = False
    methods: tuple[Literal["nearest", "joint"], ...] = ("nearest", "joint")
    noise: tuple[float, ...] = (0.0, 1.0, 2.0)
    sigma_scale: float = 1.4
    seed: int = 1
    output: Annotated[Optional[Path], arg(aliases=["-o"])] = None  # noqa: UP045
    force: bool = False


def study(options: Study) -> list[dict[str, Any]]:
    """Carry the study out; prints each result as it is there.

    Parameters
    ----------
    options : Study

    Returns
    -------
    list of dict
        One for each run, level of noise, method, kind of landmark and level (`local`, `map`).
    """
    results: list[dict[str, Any]] = []
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS), flush=True)
    for path in options.runs:
        recording = read_recording(
            path, circles=options.circles or not options.lines, lines=options.lines
        )
        centre = camera_xy_of(recording, path)
        camera_xy = (float(centre[0]), float(centre[1]))
        for factor in options.noise:
            noisy = with_relative_noise(recording, factor, options.seed)
            for method in options.methods:
                local = LocalSettings(method=method, sigma_scale=options.sigma_scale)
                began = time.thread_time()
                found = associate_run(noisy, AssociateSettings(local=local), camera_xy=camera_xy)
                seconds = time.thread_time() - began
                for kind, levels in score_run(recording, found).items():
                    for level, score in levels.items():
                        results.append(
                            {
                                "run": path.name if path.is_dir() else f"{path.parent.name}/",
                                "noise": factor,
                                "method": method,
                                "kind": kind,
                                "level": level,
                                **asdict(score),
                                "seconds": seconds,
                                "loop_matches": len(found.matches),
                                "incomplete_frames": found.incomplete_frames,
                            }
                        )
                        print(_line(results[-1]), flush=True)
    return results


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = tyro.cli(Study, args=sys.argv[1:] if arguments is None else arguments)
    try:
        results = study(options)
        if options.output is not None:
            with write_whole(options.output, overwrite=options.force) as stream:
                stream.write((json.dumps(results, indent=1) + "\n").encode())
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _line(result: dict[str, Any]) -> str:
    cells = (
        *(result["run"], f"{result['noise']:g}", result["method"], result["kind"]),
        result["level"],
        *(f"{result[name]:.4f}" for name in ("pair_precision", "pair_recall", "right_rows")),
        f"{result['found_landmarks']} of {result['true_landmarks']}",
        *(str(result["wrong_merges"]), str(result["splits"]), f"{result['seconds']:.1f}"),
    )
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    sys.exit(main())
