"""Rigid motions in space and in the plane; poses over time: files, other times, alignment."""
