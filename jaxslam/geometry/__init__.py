"""Batched rotations and rigid transforms in NumPy, for host code."""
