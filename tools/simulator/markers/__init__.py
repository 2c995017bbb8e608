"""Rendered photographs of square markers with exact truth: single frames and whole sessions."""
