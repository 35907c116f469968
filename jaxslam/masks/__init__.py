"""Masks of things that move: from a detector's boxes, and carried on from frame to frame."""
