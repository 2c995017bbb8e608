"""Calibrations of other programs: OpenCV, ROS, Kalibr, COLMAP.

`models` are their lenses, `conversion` takes a camera from one to another.
"""
