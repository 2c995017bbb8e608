"""Calibration of a camera by views of boards, and its pose over the floor.

`calibrate` goes from points to a camera: `start` by homographies, `fit` and `adjustment` by least
squares, `choice` of the lens's free coefficients, `checks` of what came out. `floor` finds the
camera's pose by known places on the floor; `projection` says how well the result is known.
"""
