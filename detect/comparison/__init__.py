"""Detected rows held against reference rows of the same run."""
