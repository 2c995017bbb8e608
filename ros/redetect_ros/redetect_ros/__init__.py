"""Redetect as a node of ROS 2."""
