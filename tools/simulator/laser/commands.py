"""The command ``laser-session`` of the simulator."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tools.simulator.laser.settings import LaserSettings


@dataclass(frozen=True)
class LaserSession:
    """Simulate a session of a robot watched by fixed laser scanners and marker cameras.

    No images: scans, odometry, poses from markers, distances, clocks, and the truth.
    """

    output: Annotated[Path, tyro.conf.Positional]
    """Folder of the session."""
    seed: int = 1
    """Everything about it follows from it and the settings."""
    picture: bool = False
    """Also draw map, way, scanners and one set of scans: session.png."""
    force: bool = False
    """Replace files that exist."""
    session: Annotated[LaserSettings, tyro.conf.arg(name="")] = field(default_factory=LaserSettings)


def perform(command: LaserSession) -> str:
    """Carry the command out.

    Returns
    -------
    str
        What was made.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress

    from tools.simulator.laser.session_files import write_session

    with Progress(BarColumn(), MofNCompleteColumn()) as progress:
        task = progress.add_task("", total=10)
        plan = write_session(
            command.session, command.output, seed=command.seed, overwrite=command.force,
            on_file=lambda: progress.advance(task),
        )  # fmt: skip
    if command.picture:
        from tools.simulator.laser.picture import draw_session

        draw_session(command.output, command.output / "session.png", overwrite=command.force)
    inside = sum(end - begin for begin, end in plan.visits)
    away = plan.route.end_s - plan.route.start_s - inside
    return f"{len(plan.visits)} visits, {inside:.0f} s in the room and {away:.0f} s outside"
