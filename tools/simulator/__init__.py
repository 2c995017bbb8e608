"""Rendered runs with known truth: what the camera of a robot would see, frame by frame.

Nothing here uses the tables or the models of the detectors that are tested with it.
"""
