"""Filters: localisation in a known map (`localizer`), EKF-SLAM (`ekf_slam`).

Both process a recording frame by frame; `base` has the measurement models, and associates rows.
"""
