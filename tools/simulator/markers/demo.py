"""The settings of the session that comes with the project (images/m)."""

from __future__ import annotations

from tools.simulator.markers.session import SessionSettings

DEMO = SessionSettings(
    name="m",
    seed=5,
    cameras=2,
    area_m=(2.2, 1.8),
    width=800,
    height=600,
    references=4,
    steps=14,
    rate_hz=1.0,
    speed_m_s=0.3,
)
DEMO_QUALITY = 90
