"""Cues to what moves: pure functions from what a frame shows of the points to how much each of them counts."""
