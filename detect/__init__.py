"""From one image to landmarks, their comparison with a reference, the command line."""


def __getattr__(name: str) -> str:
    """The version, looked up when it is asked for: that takes longer than all else here."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        found = version("redetect")
    except PackageNotFoundError:  # a checkout that was never installed
        found = "unknown"
    globals()["__version__"] = found  # the next one that asks finds it there
    return found
