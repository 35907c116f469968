"""Rotations and rigid motions of many poses at once, in NumPy, for the host."""
