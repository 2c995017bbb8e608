"""Soak test: long runs, and many short ones, checked for leaks, slowdown and leftovers."""
