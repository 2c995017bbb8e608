"""The commands of the program `camera`, but `level`, which needs detection."""
