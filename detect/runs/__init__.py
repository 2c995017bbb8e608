"""A whole run: frames in, rows out, by any number of workers, and not lost when it ends early."""
