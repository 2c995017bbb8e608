"""Odometry and measured poses together, and the clocks of both."""
