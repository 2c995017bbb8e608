"""Rows in other programs' formats: CSV, Parquet, and MCAP as ROS 2 records it.

The columns are those of `landmarks.columns`, the numbers those of the files.

    options    the flags of ``detect export``
    rows       a file's rows, one after the other, with their frames and times
    writers    the formats
    command    what ``detect export`` does
"""
