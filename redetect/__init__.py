"""Landmarks from robot images: discs on the floor and verticals, with covariances."""
