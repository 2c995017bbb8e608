"""Scripts that make, fetch, measure or time things."""
