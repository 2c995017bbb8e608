"""Filters: localisation in a known map (`localizer`), EKF-SLAM (`ekf_slam`).

Both take a recording frame by frame (`frames`), choose landmarks for rows without identifiers
(`association`) and share the compiled innovation (`innovation_kernels`); `report` has their
figures.
"""
