"""Settings tried over a grid, and what precision and recall they give."""
