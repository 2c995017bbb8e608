"""Reports as one HTML page each: their parts, their figures, and the template."""
