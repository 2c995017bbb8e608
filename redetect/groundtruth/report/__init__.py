"""The content of a session on one page."""
