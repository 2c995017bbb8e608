"""Rigid motions in space and in the plane; trajectories: files, interpolation, alignment."""
