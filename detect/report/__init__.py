"""The report of a run: a page with its results and their quality."""
