"""Poses over time: files, other times, rigid alignment of whole paths."""
