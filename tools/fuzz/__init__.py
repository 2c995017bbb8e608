"""Throw damaged files at every reader: `python -m tools.fuzz`, and the short run of the tests."""
