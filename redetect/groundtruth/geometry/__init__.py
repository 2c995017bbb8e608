"""Rigid motions: in space, in the plane, and the covariances of poses."""
