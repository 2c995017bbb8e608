"""One frame: rays through all pixels of the full, interlaced image."""
