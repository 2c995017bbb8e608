"""Processes a run: frames in, rows out, with any number of workers; resumes interrupted runs."""
