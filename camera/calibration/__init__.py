"""Calibration of a camera from views of boards, and its pose above the floor.

`calibrate` computes a camera from points: `start` by homographies, `adjustment` by least squares of
the `model`, `choice` of the lens's free coefficients, and checks of the result. `floor` estimates
the camera's pose from known points on the floor.
"""
