"""Boards for calibration (`board`), and their points in an image (`points`, `charuco`)."""
