"""Verticals of the building: filter, tracks, fitted lines, bearings, and the tilt they agree on."""
