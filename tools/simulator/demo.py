"""The demo run of the project, images/e."""

from __future__ import annotations

from tools.simulator.drive import DriveStyle
from tools.simulator.plan import RunSettings
from tools.simulator.sensor import Sensor

#: 80 frames: along a corridor, into a room with sunlit windows, back and on along the corridor.
DEMO = RunSettings(
    name="e",
    frames=80,
    seed=8,
    discs=32,
    lookalikes=16,
    visits=0.8,
    style=DriveStyle(step_m=0.25, tilt_deg=0.5),
    sensor=Sensor(jpeg_quality=85),
)
