"""Scanners, scans and building: matching, alignment, tracking of a robot."""
