"""Odometry and measured poses together: filter forward, smoothing backward."""
