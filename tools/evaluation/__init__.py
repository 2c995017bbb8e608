"""The figures of the documentation, each printed by ``python -m tools.evaluation NAME``."""
