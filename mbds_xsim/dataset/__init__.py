"""Data sets: made, checked, published, read."""
