"""Scripts that generate data, measure or time things."""
