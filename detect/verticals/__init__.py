"""Verticals of the building: filter, tracks, fitted lines, bearings, and the consensus tilt."""
