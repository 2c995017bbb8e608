"""Where the robot really was: its poses from markers seen by calibrated cameras.

Frames: the *robot* has x forward, y left, z up; the *world* z up, and the robot's heading theta is
its x axis' angle in the world, counter-clockwise; *cameras* and *markers* as in `camera` and
`landmarks`. A transform `a_from_b` takes points of frame b to frame a. Metres, radians, seconds.
"""


def __getattr__(name: str) -> str:
    """The version, looked up when it is asked for: that takes longer than all else here."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("redetect")
    except PackageNotFoundError:  # a checkout that was never installed
        return "unknown"
