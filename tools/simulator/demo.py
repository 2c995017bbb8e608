"""The demo run of the project, images/e."""

from __future__ import annotations

from tools.simulator.drive import DriveStyle
from tools.simulator.plan import RunSettings
from tools.simulator.sensor import Sensor

#: 80 frames from a corridor into a room and round a corner.
DEMO = RunSettings(
    name="e",
    frames=80,
    seed=5,
    discs=60,
    lookalikes=18,
    visits=0.8,
    style=DriveStyle(step_m=0.25),
    sensor=Sensor(jpeg_quality=88),
)
