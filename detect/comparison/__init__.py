"""Compares detected rows with reference rows of the same run."""
