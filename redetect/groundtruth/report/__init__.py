"""Report on a session, on one page."""
