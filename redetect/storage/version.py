"""The version of this project, defined only here."""

__version__ = "0.1.0"
