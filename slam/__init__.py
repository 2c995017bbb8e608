"""What landmarks are for: least-squares map, localisation, EKF-SLAM, association, noise.

Frames are the data set's: the robot has X left, Y backward (forward is -Y); the map is the robot's
frame at the start of the run. A pose is (x, y, theta). Metres, radians.

>>> from slam.recording import read_recording
>>> recording = read_recording("images/e", circles=True, lines=True)    # doctest: +SKIP
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
