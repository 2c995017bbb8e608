"""The robot's clock against the ground truth's."""
