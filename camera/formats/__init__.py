"""Calibrations of other programs: OpenCV, ROS, Kalibr, COLMAP.

`models` are their lenses, `yaml_files` and `colmap` their files; `conversion` takes a camera from
one model to another, `command` is `camera convert`.
"""
