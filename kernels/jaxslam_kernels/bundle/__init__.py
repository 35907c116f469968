"""Weighted bundle adjustment by the Schur complement."""
