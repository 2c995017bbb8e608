"""Poses of a robot from square markers in images, and the calibrations that it takes."""
