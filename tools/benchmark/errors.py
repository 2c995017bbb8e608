"""What can go wrong in a benchmark."""


class BenchmarkError(ValueError):
    """A benchmark could not be carried out; the message says what was expected."""
