"""Detections drawn into their images."""
