"""Calibration of a camera by views of boards, and its pose over the floor.

`calibrate` goes from points to a camera: `start` by homographies, `adjustment` by least squares of
the `model`, `choice` of the lens's free coefficients, and checks of the result. `floor` finds the
camera's pose by known places on the floor; `command` is `camera calibrate`.
"""
