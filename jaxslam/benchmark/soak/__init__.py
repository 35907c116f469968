"""Soak tests: hours of tracking in one place, and what grows meanwhile."""
