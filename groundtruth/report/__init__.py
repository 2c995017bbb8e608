"""What a session holds, on one page."""
