"""Rows in other programs' formats: CSV, Parquet, and MCAP as ROS 2 records it.

The columns are those of `redetect.landmarks.columns`, the numbers those of the files.
"""
