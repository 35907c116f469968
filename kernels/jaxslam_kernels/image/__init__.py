"""Image pyramids, corners, and patches around points."""
