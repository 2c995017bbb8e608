"""Filters: localisation in a known map (`localizer`), EKF-SLAM (`ekf_slam`).

Both take a recording frame by frame (`frames`), which has how landmarks are seen and how rows
without identifiers are paired with them.
"""
