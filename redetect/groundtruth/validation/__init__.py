"""Evaluation of poses against a truth or surveyed reference poses."""
