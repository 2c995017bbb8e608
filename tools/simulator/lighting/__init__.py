"""How light spreads in the building before the first frame."""
