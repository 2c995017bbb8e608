"""Calibrations of other programs: OpenCV, ROS, Kalibr, COLMAP.

`models` are their lens models, `yaml_files` and `colmap` their files; `conversion` converts a
camera from one model to another, `files` chooses among them.
"""
